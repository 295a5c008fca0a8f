"""Learning from what was recorded: the same weights, or another algorithm on the same episodes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from actors.task import make_task_env
from broker_config.codec import encode
from broker_config.errors import MessageError, PresetError, StorageError
from broker_config.journal import Journal
from broker_config.messages import (
    SnapshotTaken,
    Ticket,
    TicketRequest,
    Trajectory,
    TrajectoryId,
)
from broker_config.preset import Preset
from deploy.offline.origin import keep_origin, origin_of
from deploy.offline.recorded_episodes import RecordedEpisodes, RecordedRun
from deploy.offline.train_from import (
    RecordedActor,
    compare_weights,
    load_reward,
    offline_preset,
    recorded_demonstrations,
    train_from,
)
from deploy.presets import load_preset
from deploy.run_folder import RunFolder, prepare_run_folder, require_acting
from deploy.running.in_process import InProcessActor
from learner.checkpoint import CheckpointStore
from learner.learning import LearningLoop
from learner.owner import Owner
from learner.snapshots import SnapshotStore
from learner.steps.compute import ON_CPU
from learner.trainer import Trainer

torch.set_num_threads(1)

MakeTrajectory = Callable[..., Trajectory]
PRESET = load_preset("reaching-smoke")
LAGGING = load_preset("reaching-smoke", ["schedule.policy_lag=3", "task.horizon=3"])
SMALL = LAGGING.task.observation_shape


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A whole run of the smoke preset."""
    return play(tmp_path_factory.mktemp("played") / "run", PRESET)


def play(path: Path, preset: Preset, episodes: int | None = None) -> RunFolder:
    folder = prepare_run_folder(path, preset)
    with Journal(folder.journal) as journal, closing(make_task_env(preset.task)) as env:
        owner = Owner(folder.run, preset, journal)
        snapshots = SnapshotStore(folder.snapshots)
        actor = InProcessActor(owner, env, snapshots)
        checkpoints = CheckpointStore(folder.checkpoints)
        loop = LearningLoop(
            owner, Trainer(preset), checkpoints, snapshots, None, actor.play_until_ready
        )
        for number, _ in enumerate(loop):
            if episodes is not None and number >= 2 * episodes:
                break
    return folder


def learn(
    path: Path, episodes: RecordedEpisodes, preset: Preset, reward: str | None = None
) -> RunFolder:
    folder = prepare_run_folder(path, preset)
    function = load_reward(reward) if reward else None
    console = Console(file=StringIO())
    assert train_from(folder, preset, episodes, None, function, ON_CPU, console)
    return folder


def test_the_same_run_learned_again_has_the_same_weights(played: RunFolder, tmp_path: Path) -> None:
    recorded = RecordedRun(played.path)
    episodes = RecordedEpisodes([recorded])
    preset = offline_preset(episodes, None, ())
    assert preset == recorded.preset
    again = learn(tmp_path / "again", episodes, preset)
    comparison = compare_weights(again, recorded)
    assert comparison.same == (0, 1, 2, 3, 4)
    assert str(comparison) == "the weights of all 5 policy versions are the recorded ones"


def test_another_algorithm_learns_from_the_same_episodes(played: RunFolder, tmp_path: Path) -> None:
    recorded = RecordedRun(played.path)
    episodes = RecordedEpisodes([recorded])
    preset = offline_preset(episodes, None, ["algorithm.method=dqn"])
    other = learn(tmp_path / "dqn", episodes, preset)
    comparison = compare_weights(other, recorded)
    assert comparison.others
    assert "from version" in str(comparison)
    mine = RecordedRun(other.path)
    for index in range(recorded.episodes):
        (left,), (right,) = mine.parts(index), recorded.parts(index)
        np.testing.assert_array_equal(left.observations, right.observations)
        np.testing.assert_array_equal(left.actions, right.actions)


def test_other_rewards_are_learned_from(
    played: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_rewards.py").write_text(
        "import numpy as np\n"
        "def dark(trajectory):\n"
        "    return -trajectory.observations[1:].mean((1, 2, 3))\n"
        "def short(trajectory):\n"
        "    return np.zeros(1)\n"
        "missing = 3\n"
    )
    monkeypatch.chdir(tmp_path)
    recorded = RecordedRun(played.path)
    episodes = RecordedEpisodes([recorded])
    preset = offline_preset(episodes, None, ["schedule.iterations=1"])
    dark = learn(tmp_path / "dark", episodes, preset, "my_rewards:dark")
    (first,) = RecordedRun(dark.path).parts(0)
    expected = -first.observations[1:].mean((1, 2, 3)).astype(np.float32)
    np.testing.assert_array_equal(first.rewards, expected)
    task = learn(tmp_path / "task", episodes, preset, "task")
    assert compare_weights(task, recorded).others == ()
    with pytest.raises(MessageError, match=r"expected 10 finite numbers.*got float64 \[1\]"):
        learn(tmp_path / "short", episodes, preset, "my_rewards:short")
    for name in ("my_rewards:missing", "my_rewards:none", "nothing:none", "my_rewards"):
        with pytest.raises(PresetError, match="--reward: expected"):
            load_reward(name)


def test_a_stopped_run_gives_as_many_iterations_as_it_has(tmp_path: Path) -> None:
    stopped = RecordedRun(play(tmp_path / "stopped", PRESET, episodes=3).path)
    assert stopped.episodes == 3
    episodes = RecordedEpisodes([stopped])
    preset = offline_preset(episodes, None, ())
    assert preset.schedule.iterations == 1
    again = learn(tmp_path / "again", episodes, preset)
    assert compare_weights(again, stopped).same == (0, 1, 2)
    with pytest.raises(PresetError, match="expected 4 recorded episodes for 2 iterations; got 3"):
        offline_preset(episodes, None, ["schedule.iterations=2"])


def test_several_runs_are_one_after_the_other(played: RunFolder, tmp_path: Path) -> None:
    first = RecordedRun(played.path)
    both = RecordedEpisodes([first, RecordedRun(played.path)])
    assert len(both) == 2 * first.episodes
    (left,), (right,) = both.parts(1), both.parts(5)
    assert left.id == right.id
    assert offline_preset(both, None, ()).schedule.iterations == 4
    with pytest.raises(StorageError, match="expected an episode below 8"):
        both.parts(8)
    other = load_preset("reaching-smoke", ["task.options.n_joints=5", "task.n_actions=25"])
    with pytest.raises(PresetError, match=r"and 10 actions; got .* and 25 actions"):
        RecordedEpisodes([first, RecordedRun(play(tmp_path / "other", other, 2).path)])


def test_another_task_is_refused(played: RunFolder) -> None:
    episodes = RecordedEpisodes([RecordedRun(played.path)])
    with pytest.raises(PresetError, match="expected the task that was recorded"):
        offline_preset(episodes, load_preset("reaching-ch3"), ())
    with pytest.raises(PresetError, match=r"with 10 steps.* got .* with 9 steps"):
        offline_preset(episodes, None, ["task.horizon=9"])
    assert recorded_demonstrations(episodes.runs).trajectories == ()


def test_a_folder_goes_on_with_what_it_was_begun_with(played: RunFolder, tmp_path: Path) -> None:
    episodes = RecordedEpisodes([RecordedRun(played.path)])
    folder = prepare_run_folder(tmp_path / "offline", PRESET)
    keep_origin(folder, begun := origin_of(episodes, None, "my_rewards:dark"))
    keep_origin(folder, begun)
    assert begun.command == f"clothbus train --from {played.path} --reward my_rewards:dark"
    with pytest.raises(
        StorageError, match=r"with which it was begun, clothbus train --from .*dark"
    ):
        keep_origin(folder, origin_of(episodes, None, None))
    both = RecordedEpisodes([*episodes.runs, *episodes.runs])
    with pytest.raises(StorageError, match="with which it was begun"):
        keep_origin(folder, origin_of(both, None, "my_rewards:dark"))
    with pytest.raises(PresetError, match="got one that learns from recordings"):
        require_acting(folder)
    require_acting(played)
    with pytest.raises(StorageError, match="got a run's; name another"):
        keep_origin(played, begun)
    folder.offline.write_text("{}")
    with pytest.raises(StorageError, match="expected what this run learns from"):
        keep_origin(folder, begun)


# Episodes that did not come one by one ----------------------------------------------------------


class Collector:
    """Has an owner's tickets answered in whatever order."""

    def __init__(self, folder: RunFolder, make: MakeTrajectory) -> None:
        self._make = make
        self._journal = Journal(folder.journal)
        self.owner = Owner(folder.run, LAGGING, self._journal)
        self.owner.policy_ready(SnapshotTaken(0, "ab" * 32, 0))
        self._sequence = 0

    def ticket(self, actor: str) -> Ticket:
        issued = self.owner.issue(TicketRequest(actor, "life", f"n{self._sequence}"), 0.0)
        self._sequence += 1
        assert issued is not None
        issued[1].result(10)
        assert issued[0].ticket is not None
        return issued[0].ticket

    def deliver(self, actor: str, ticket: Ticket, steps: int = 3) -> TrajectoryId:
        made = self._make(self._sequence, actor, "life", steps=steps)
        pictures = np.zeros((steps + 1, *SMALL), np.uint8)
        trajectory = replace(
            made,
            ticket=ticket,
            observations=pictures,
            actions=made.actions % 10,
            interrupted=steps < ticket.steps,
        )
        self._sequence += 1
        self.owner.receive(trajectory, encode(trajectory)).result(10)
        return trajectory.id

    def close(self) -> None:
        self._journal.close()


def test_episodes_come_in_the_order_of_their_tickets(
    tmp_path: Path, make_trajectory: MakeTrajectory
) -> None:
    folder = prepare_run_folder(tmp_path / "run", LAGGING)
    with closing(Collector(folder, make_trajectory)) as collector:
        tickets = [collector.ticket(actor) for actor in "abcd"]
        third = collector.deliver("c", tickets[2])
        fourth = collector.deliver("d", tickets[3])
        first = collector.deliver("a", tickets[0])
        half = collector.deliver("b", tickets[1], steps=1)
        rest = collector.deliver("b", collector.ticket("b"), steps=2)
    run = RecordedRun(folder.path)
    assert run.episodes == 4
    assert [[it.id for it in run.parts(index)] for index in range(4)] == [
        [first],
        [half, rest],
        [third],
        [fourth],
    ]
    assert [it.id for it in run.parts(1)] == [half, rest], "going back"


def test_what_is_behind_a_gap_is_left_out(tmp_path: Path, make_trajectory: MakeTrajectory) -> None:
    folder = prepare_run_folder(tmp_path / "run", LAGGING)
    with closing(Collector(folder, make_trajectory)) as collector:
        tickets = [collector.ticket(actor) for actor in "abc"]
        collector.deliver("a", tickets[0])
        collector.deliver("c", tickets[2])
    run = RecordedRun(folder.path)
    assert (run.episodes, run.left_out) == (1, 1)
    with pytest.raises(StorageError, match="expected an episode of 0 to 0; got 1"):
        run.parts(1)


def test_an_interrupted_episode_is_answered_part_by_part(
    tmp_path: Path, make_trajectory: MakeTrajectory
) -> None:
    folder = prepare_run_folder(tmp_path / "run", LAGGING)
    with closing(Collector(folder, make_trajectory)) as collector:
        collector.deliver("a", collector.ticket("a"), steps=1)
        collector.deliver("a", collector.ticket("a"), steps=2)
    again = prepare_run_folder(tmp_path / "again", LAGGING)
    episodes = RecordedEpisodes([RecordedRun(folder.path)])
    with Journal(again.journal) as journal:
        owner = Owner("again", LAGGING, journal)
        owner.policy_ready(SnapshotTaken(0, "ab" * 32, 0))
        actor = RecordedActor(owner, episodes, None)
        assert not actor.play_until_ready(0)
        assert actor.play_until_ready(0)
        assert [it.steps for it in owner.trajectories(0)] == [1, 2]
    for wrong in (Ticket(0, 0, 2, 7, 0, 3, 0.0), Ticket(0, 0, 1, 7, 0, 1, 0.0)):
        with pytest.raises(MessageError, match=r"expected part .* got recorded parts of \[1, 2\]"):
            episodes.answer(wrong)


def test_a_folder_without_episodes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StorageError):
        RecordedRun(tmp_path)
    folder = prepare_run_folder(tmp_path / "run", PRESET)
    with Journal(folder.journal) as journal:
        Owner(folder.run, PRESET, journal)
    with pytest.raises(StorageError, match="expected a run with at least one whole episode"):
        RecordedRun(folder.path)
