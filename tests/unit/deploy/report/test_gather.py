"""What a report says of a run is what happened in it."""

from __future__ import annotations

import dataclasses
import shutil
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import softplus

from broker_config.codec import decode, encode
from broker_config.errors import StorageError
from broker_config.journal import JournalReader
from broker_config.messages import (
    AttemptEnded,
    Command,
    JournalEntry,
    Metrics,
    Rewards,
    RunStarted,
    SnapshotTaken,
    Ticket,
    TicketIssued,
    Trajectory,
    TrajectoryId,
    Verdict,
)
from broker_config.recording.reader import TornSegment, iter_recording
from broker_config.recording.recording import RecordedMessage, Recording
from deploy.evaluation.scores import scores_of
from deploy.presets import load_preset
from deploy.report.composition import mean_parts
from deploy.report.gather import gather
from deploy.report.record import RunRecord
from deploy.report.sources import open_source
from discriminator.labelling import state_of, states_after
from discriminator.real_states import real_states
from discriminator.trainer import Discriminators
from learner.recorded import accepted_trajectories
from learner.tickets import make_ticket
from tests.unit.deploy.report.conftest import ITERATIONS, MadeRun

EPISODES = 2 * ITERATIONS


def test_every_episode_is_told_once_with_its_return(run: MadeRun, gathered: RunRecord) -> None:
    with JournalReader(run.folder.journal) as journal:
        accepted = list(accepted_trajectories(journal))
    episodes = gathered.episodes
    assert episodes.indices.tolist() == list(range(EPISODES))
    assert episodes.returns.tolist() == [it.return_ for it in accepted]
    assert episodes.steps.tolist() == [it.steps for it in accepted]
    assert episodes.lags.tolist() == [0] * EPISODES
    assert (gathered.is_complete, gathered.state, gathered.repeated) == (True, "complete", 0)
    assert (gathered.demonstrations, gathered.demonstrated_samples) == (3, 30)

    shown = gathered.shown
    assert (shown["first"].index, shown["last"].index) == (0, EPISODES - 1)
    assert shown["best"].return_ == max(it.return_ for it in accepted)
    assert (shown["last"].parts[0].observations == accepted[-1].observations).all()


def test_faults_are_counted_and_named(run: MadeRun, gathered: RunRecord) -> None:
    assert len(gathered.starts) == 2
    assert gathered.away_secs > 0
    (lost,) = gathered.wrong
    assert (lost.ticket, lost.actor, lost.verdict) == (0, "actor-9", Verdict.LOST)
    assert lost.reason == "actor-9 not heard of for 5 s"
    assert gathered.verdicts == {Verdict.ACCEPTED: EPISODES, Verdict.LOST: 1}
    assert gathered.attempts["in-process"].issued == EPISODES
    assert gathered.actor_starts == {"actor-9": 1, "in-process": 2}
    assert [it.command for it in gathered.orders] == [Command.PAUSE, Command.RESUME]

    assert gathered.recorded is not None
    assert len(gathered.recorded.away) == 1
    assert gathered.recorded.gaps == {"metrics": 3}
    roles = [life.role for life in gathered.lives]
    assert roles == ["owner", "owner", "discriminator", "evaluator", *["actor"] * 3]
    first, second = gathered.lives[:2]
    assert second.began_secs - first.ended_secs == pytest.approx(gathered.away_secs)


def test_phases_add_up_to_the_time_from_policy_to_policy(run: MadeRun, gathered: RunRecord) -> None:
    with JournalReader(run.folder.journal) as journal:
        taken = [it.unix_secs for it in journal.entries("snapshot/")]
    assert [it.number for it in gathered.iterations] == list(range(ITERATIONS))
    totals = [it.phases.total for it in gathered.iterations]
    assert totals == pytest.approx(np.diff(taken), abs=1e-3)
    assert gathered.iterations[0].phases.away == pytest.approx(gathered.away_secs)
    assert all(it.phases.rewards > 0 and it.phases.updates > 0 for it in gathered.iterations)
    assert [it.gradient_secs for it in gathered.iterations] == [None, 0.25]


def test_parts_of_rewards_are_those_of_the_discriminators_that_gave_them(
    run: MadeRun, gathered: RunRecord
) -> None:
    with JournalReader(run.folder.journal) as journal:
        given = [decode(it.payload, Rewards) for it in journal.entries("rewards/")]
        accepted = list(accepted_trajectories(journal))
    assert run.preset.imitation is not None
    real = real_states(run.demonstrations.trajectories, run.preset.imitation.target_reward)
    for rewards, row in zip(given, gathered.rewarded, strict=True):
        states = states_after(accepted[: 2 * (rewards.iteration + 1)], len(rewards.rewards))
        discriminators = Discriminators(run.preset, real)
        discriminators.set_state(state_of(rewards))
        wanted = {
            name: float(softplus(logits).mean())
            for name, logits in discriminators.logits(states).items()
        }
        assert row.parts == pytest.approx(wanted, abs=1e-5)
        assert mean_parts(run.preset, rewards, states.numpy()) == pytest.approx(wanted, abs=1e-5)
        # The rewards themselves: the parts' sum, centred (eq. 4.3).
        total = sum(softplus(it) for it in discriminators.logits(states).values())
        torch.testing.assert_close(torch.tensor(rewards.rewards), total - total.mean())
        assert row.numbers == dict(rewards.numbers)


def test_scores_are_those_of_the_evaluation(run: MadeRun, gathered: RunRecord) -> None:
    assert [it.version for it in gathered.scores] == [0, ITERATIONS]
    assert gathered.scores == run.scores


def test_a_recording_alone_says_the_same(run: MadeRun, gathered: RunRecord, tmp_path: Path) -> None:
    folder = tmp_path / "elsewhere"
    shutil.copytree(run.folder.recording, folder)
    (score,) = [it for it in run.scores if it.version == ITERATIONS]
    with Recording(folder, run.folder.run, "rec-3") as recording:
        numbers = {"version": float(score.version), **score.numbers}
        recording.add_live(Metrics("evaluator", "evaluator", "inc", 0, EPISODES, numbers))
        recording.flush()  # and is killed: the segment is torn

    with pytest.raises(TornSegment):
        list(iter_recording(folder))
    source = open_source(folder)
    alone = gather(source)
    assert alone.preset == run.preset
    assert alone.episodes.returns.tolist() == gathered.episodes.returns.tolist()
    assert alone.iterations == gathered.iterations
    assert alone.rewarded == gathered.rewarded
    assert alone.wrong == gathered.wrong
    assert alone.scores == [dataclasses.replace(score, returns=())]
    assert alone.recorded is not None
    assert len(alone.recorded.away) == 2

    newest = source.newest_policy()
    of_folder = open_source(run.folder.path).newest_policy()
    assert newest is not None
    assert of_folder is not None
    picture = gathered.shown["last"].parts[0].observations[0]
    assert newest[0] == of_folder[0] == ITERATIONS
    assert (newest[1].preferences(picture) == of_folder[1].preferences(picture)).all()


def test_a_run_under_way_is_told_as_far_as_it_is(run: MadeRun, tmp_path: Path) -> None:
    class Early:
        """The source, when only so many entries were there."""

        def __init__(self, n_entries: int) -> None:
            self.source, self.n_entries = open_source(run.folder.path), n_entries
            self.path, self.preset, self.missing = run.folder.path, run.preset, ()

        def entries(self):  # type: ignore[no-untyped-def]
            return (it for it in self.source.entries() if it.offset < self.n_entries)

        def live(self):  # type: ignore[no-untyped-def]
            return iter(())

        def evaluations(self):  # type: ignore[no-untyped-def]
            return scores_of([], 0)

        def newest_policy(self) -> None:
            return None

    n_all = open_source(run.folder.path).n_entries
    assert n_all is not None
    told: list[int] = []
    for n_entries in range(1, n_all):
        early = gather(Early(n_entries), told.append)
        assert early.entries == n_entries
        assert early.is_complete == (early.newest_version == ITERATIONS)
        assert early.episodes.indices.tolist() == list(range(len(early.episodes)))
        assert early.n_wrong <= 1
    assert not told, "fewer entries than it tells of"


class LongRun:
    """A source of so many episodes, made while they are read: none is kept here."""

    def __init__(self, n_episodes: int) -> None:
        settings = (f"schedule.iterations={n_episodes}", "schedule.episodes_per_iteration=1")
        self.preset = load_preset("reaching-smoke", settings)
        self.path, self.missing, self.n_entries = Path("long"), (), None
        self._n_episodes = n_episodes

    def entries(self) -> Iterator[JournalEntry]:
        messages = enumerate(self._messages())
        for offset, (name, message) in messages:
            yield JournalEntry(offset, name, encode(message), float(offset))

    def _messages(self) -> Iterator[tuple[str, object]]:
        yield "run/1", RunStarted("long", 1, self.preset.to_json(), "0")
        yield "snapshot/0/0", SnapshotTaken(0, "0", 0)
        for index in range(self._n_episodes):
            ticket = make_ticket(self.preset, index)
            yield f"ticket/{index}/0", TicketIssued(ticket, "a", "i", str(index))
            trajectory = played(ticket, index)
            yield f"trajectory/{trajectory.id}", trajectory
            ended = AttemptEnded(index, 0, Verdict.ACCEPTED, trajectory.id, ticket.steps, True, "")
            yield f"ended/{trajectory.id}", ended
            yield f"snapshot/{index + 1}/0", SnapshotTaken(index + 1, "0", index + 1)

    def live(self) -> Iterator[RecordedMessage]:
        return iter(())

    def evaluations(self) -> None:
        return None

    def newest_policy(self) -> None:
        return None


def played(ticket: Ticket, index: int) -> Trajectory:
    """An episode whose pictures are far larger than what a record keeps of it."""
    return Trajectory(
        TrajectoryId("a", "i", index),
        ticket,
        np.full((ticket.steps + 1, 42, 42, 3), index % 256, np.uint8),
        np.zeros(ticket.steps, np.int32),
        np.full(ticket.steps, float(index), np.float32),
        terminated=False,
        truncated=True,
        success=False,
        guard=None,
        interrupted=False,
        ended_unix_secs=0.0,
    )


def peak_bytes(n_episodes: int) -> int:
    tracemalloc.start()
    try:
        record = gather(LongRun(n_episodes))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(record.episodes) == n_episodes
    assert record.shown["best"].index == n_episodes - 1
    return peak


def test_memory_does_not_grow_with_the_run() -> None:
    gather(LongRun(2))  # what is cached
    assert peak_bytes(300) < 1.5 * peak_bytes(20)


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"expected a run folder .* or a recording"):
        open_source(tmp_path)
    with pytest.raises(StorageError, match=r"expected a run folder .* or a recording"):
        open_source(tmp_path / "nowhere")
