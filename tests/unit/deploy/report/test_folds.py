"""The parts of a report's record: phases, lives, episodes in parts, running means."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from broker_config.messages import AttemptEnded, Presence, Ticket, Trajectory, TrajectoryId, Verdict
from deploy.presets import load_preset
from deploy.report.episodes import EpisodeLog
from deploy.report.lives import Life, LifeBook
from deploy.report.phases import PhaseClock, PhaseSecs
from deploy.report.running import running_mean, running_rate, window_of
from deploy.report.tables import duration, thinned

SCHEDULE = load_preset("imitation-smoke").schedule  # 3 episodes, then an update


def test_a_phase_lasts_until_what_was_waited_for_is_committed() -> None:
    clock = PhaseClock(SCHEDULE)

    def at(secs: float, *, starts_owner: bool = False) -> PhaseClock:
        clock.tick(1e9 + secs, starts_owner=starts_owner)
        return clock

    at(0.0, starts_owner=True)
    at(1.0).policy_known(0)
    at(2.0).episode_ended(0)
    at(3.0).episode_ended(2)
    at(5.0).episode_ended(1)  # the last to come, whatever its number
    at(5.5).episode_ended(3)  # of the next update: a lag allows it
    at(6.0).announced()
    at(36.0, starts_owner=True)  # killed some time after 6, away until here
    at(38.0).rewarded()
    at(41.0).policy_known(1)
    at(41.5).episode_ended(4)
    at(42.0).episode_ended(5)
    at(42.5).announced()
    at(43.0).rewarded()
    at(44.0).policy_known(2)

    assert clock.phases[0] == PhaseSecs(episodes=4.0, rewards=2.0, updates=4.0, away=30.0)
    assert clock.phases[1] == PhaseSecs(episodes=1.0, rewards=0.5, updates=1.5, away=0.0)
    assert (clock.phases[0].total, clock.away_secs) == (40.0, 30.0)


def test_updates_after_each_episode_count_for_their_iteration() -> None:
    clock = PhaseClock(replace(SCHEDULE, update_every="episode"))
    clock.tick(0.0, starts_owner=True)
    clock.policy_known(0)
    for index in range(4):
        clock.tick(10.0 * index + 4.0)
        clock.episode_ended(index)
        clock.tick(10.0 * index + 10.0)
        clock.policy_known(index + 1)
    assert {number: it.total for number, it in clock.phases.items()} == {0: 30.0, 1: 10.0}
    assert clock.phases[0] == PhaseSecs(episodes=12.0, updates=18.0)


def test_lives_begin_and_end_where_presence_says_so_and_with_signs_otherwise() -> None:
    book = LifeBook()
    for secs in (10.0, 12.0, 20.0):
        book.sign("actor", "a", "one", secs)
    for secs in (40.0, 50.0):
        book.sign("actor", "a", "two", secs)
    book.presence(Presence("actor", "a", is_alive=True), 9.0)
    book.presence(Presence("actor", "a", is_alive=False), 21.0)
    book.presence(Presence("actor", "a", is_alive=True), 45.0)  # a recorder came, not the actor
    for secs in (30.0, 31.0):  # heard twice, too: it came at 30
        book.presence(Presence("actor", "b", is_alive=True), secs)
    book.sign("actor", "b", "one", 35.0)
    book.presence(Presence("evaluator", "e", is_alive=True), 5.0)
    book.presence(Presence("evaluator", "e", is_alive=True), 45.0)  # the same life, heard again
    book.presence(Presence("evaluator", "e", is_alive=False), 60.0)

    assert book.lives == [
        Life("evaluator", "e", 5.0, 60.0, was_seen_to_end=True),
        Life("actor", "a", 9.0, 21.0, was_seen_to_end=True),
        Life("actor", "a", 40.0, 60.0, was_seen_to_end=False),  # it was there all the time
        Life("actor", "b", 30.0, 60.0, was_seen_to_end=False),
    ]
    assert (book.starts("actor"), book.starts_of(("actor", "a"))) == (3, 2)


def test_who_is_present_lives_for_as_long_as_somebody_records() -> None:
    book = LifeBook()
    for name, role in {"quiet": "evaluator", "gone": "actor", "busy": "actor"}.items():
        book.presence(Presence(role, name, is_alive=True), 1.0)  # type: ignore[arg-type]
    book.sign("actor", "gone", "one", 3.0)
    book.sign("actor", "busy", "one", 4.0)
    book.heard_until(5.0)
    book.recorder_started()  # the first one was killed, and an actor while nobody recorded
    for name, role in {"quiet": "evaluator", "busy": "actor"}.items():
        book.presence(Presence(role, name, is_alive=True), 10.0)  # type: ignore[arg-type]
    book.heard_until(20.0)
    assert book.lives == [
        Life("evaluator", "quiet", 1.0, 20.0, was_seen_to_end=False),
        Life("actor", "busy", 1.0, 20.0, was_seen_to_end=False),
        Life("actor", "gone", 1.0, 3.0, was_seen_to_end=False),
    ]


def test_an_episode_in_two_parts_is_one_episode() -> None:
    log = EpisodeLog(SCHEDULE)
    for part, steps in enumerate((2, 3)):
        ticket = Ticket(4, part, part, 7, 0, 5 - 2 * part, 0.0)
        trajectory = Trajectory(
            TrajectoryId("robot", f"inc-{part}", 0),
            ticket,
            np.zeros((steps + 1, 2, 2, 3), np.uint8),
            np.zeros(steps, np.int32),
            np.full(steps, -1.0, np.float32),
            terminated=False,
            truncated=True,
            success=part == 1,
            guard=None,
            interrupted=part == 0,
            ended_unix_secs=0.0,
        )
        log.take(trajectory)
        is_last = part == 1
        ended = AttemptEnded(4, part, Verdict.ACCEPTED, trajectory.id, steps, is_last, "")
        assert log.end(ended) is trajectory
    episodes = log.episodes
    assert (episodes.indices.tolist(), episodes.steps.tolist()) == ([4], [5])
    assert (episodes.returns.tolist(), episodes.successes.tolist()) == ([-5.0], [True])
    assert episodes.lags.tolist() == [1]  # after one update, it acted on the untrained policy
    assert log.best is not None
    assert [part.steps for part in log.best.parts] == [2, 3]


def test_running_means_have_the_intervals_of_the_books() -> None:
    running = running_mean(np.array([9.0, 1.0, 2.0, 3.0, 4.0, 5.0]), 5)
    assert running.ends.tolist() == [4, 5]
    assert running.means.tolist() == [3.8, 3.0]
    # Student's t with 4 degrees of freedom: 2.776 * 1.5811 / sqrt(5)
    assert running.highs[1] - 3.0 == pytest.approx(1.9633, abs=1e-3)

    none = running_rate(np.zeros(5, np.bool_), 5)
    assert (none.lows[0], none.highs[0]) == pytest.approx((0.0, 0.4345), abs=1e-4)
    most = running_rate(np.array([True] * 8 + [False] * 2), 10)
    assert (most.lows[0], most.highs[0]) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert window_of(3, 100) == 5
    assert window_of(20, 100) == 20
    assert window_of(20, 2) == 2


def test_long_runs_have_short_figures_and_tables() -> None:
    running = running_mean(np.arange(100_000.0), 50)
    assert len(running.ends) <= 400
    assert (running.ends[0], running.ends[-1]) == (49, 99_999)
    rows, note = thinned(range(1000))
    assert len(rows) <= 61
    assert (rows[0], rows[-1]) == (0, 999)
    assert note == "Each 17th of 1000 rows, and the last."


@pytest.mark.parametrize(
    ("secs", "words"),
    [
        (8.06, "8.1 s"),
        (723.0, "12 min 03 s"),
        (18_720.0, "5 h 12 min"),
        (273_600.0, "3 d 4 h"),
    ],
)
def test_times_are_written_for_a_person(secs: float, words: str) -> None:
    assert duration(secs) == words
