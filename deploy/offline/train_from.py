"""`clothbus train --from`: learns from recordings alone, as their run has learned."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from broker_config.codec import decode
from broker_config.errors import MessageError, PresetError
from broker_config.journal import JournalReader
from broker_config.messages import (
    SnapshotTaken,
    TargetsMarked,
    Ticket,
    Trajectory,
    TrajectoryId,
)
from broker_config.preset import Preset, with_settings
from deploy.offline.recorded_episodes import (
    RecordedEpisodes,
    RecordedRun,
    journal_entries,
    require_same_task,
)
from deploy.run_folder import RunFolder
from deploy.running.in_process import AnsweringActor
from deploy.running.progress import Progress
from deploy.running.run import conduct
from deploy.running.run_in_process import learn_in_process
from deploy.running.summary import is_complete
from learner.owner import Owner
from learner.recorded import Demonstrations
from learner.snapshots import SnapshotStore
from learner.steps.compute import Compute

TASK_REWARD: Final = "task"

Reward = Callable[[Trajectory], NDArray[np.float32]]
"""The rewards of a trajectory, f32[T], in place of those that were recorded."""


@dataclass(frozen=True)
class Comparison:
    """How a retrained run's policies agree with the recorded ones."""

    same: tuple[int, ...]
    """Versions whose weights are those that were recorded, bit for bit."""
    others: tuple[int, ...]
    """Versions that both have, with other weights."""

    def __str__(self) -> str:
        if not self.others:
            return f"the weights of all {len(self.same)} policy versions are the recorded ones"
        return (
            f"the weights of {len(self.same)} policy versions are the recorded ones; from version "
            f"{self.others[0]} on they differ (a run repeats itself by the same --training-path, "
            "which compute.txt in its folder names, on one type of processor)"
        )


class RecordedActor(AnsweringActor):
    """Answers tickets with recorded episodes: the k-th with the k-th."""

    def __init__(self, owner: Owner, episodes: RecordedEpisodes, reward: Reward | None) -> None:
        """Prepares an actor.

        Args:
            owner: Asked for tickets.
            episodes: At least as many as the run has.
            reward: Replaces the recorded rewards.
        """
        super().__init__(owner)
        self._episodes = episodes
        self._reward = reward

    def answer(self, id_: TrajectoryId, ticket: Ticket) -> Trajectory:
        """What was recorded of an episode, or of the part that the ticket is for."""
        recorded = self._episodes.answer(ticket)
        rewards = recorded.rewards if self._reward is None else _checked(self._reward, recorded)
        return replace(recorded, id=id_, ticket=ticket, rewards=rewards)


def offline_preset(
    episodes: RecordedEpisodes,
    base: Preset | None,
    settings: Sequence[str],
    *,
    imitates: bool = True,
) -> Preset:
    """What is learned from recordings: their own preset, or another of the same task.

    Args:
        episodes: To learn from.
        base: In place of the recorded run's preset.
        settings: That replace the preset's. The number of iterations is as many as there are
            episodes for, unless a setting says fewer.
        imitates: Whether discriminators give the rewards where the preset says so.

    Raises:
        PresetError: The task is another, or there are too few episodes.
    """
    recorded = episodes.runs[0].preset
    chosen = with_settings(base or recorded, settings)
    if not imitates:
        chosen = replace(chosen, imitation=None)
    require_same_task(chosen.task, recorded.task, chosen.name)
    per_iteration = chosen.schedule.episodes_per_iteration
    most = len(episodes) // per_iteration
    asked = any(setting.startswith("schedule.iterations=") for setting in settings)
    iterations = chosen.schedule.iterations if asked else most
    if not 1 <= iterations <= most:
        raise PresetError(
            f"{chosen.name}: expected {max(iterations, 1) * per_iteration} recorded episodes for "
            f"{max(iterations, 1)} iterations; got {len(episodes)}; ask for fewer with --set "
            "schedule.iterations=N"
        )
    return replace(chosen, schedule=replace(chosen.schedule, iterations=iterations))


def recorded_demonstrations(runs: Sequence[RecordedRun]) -> Demonstrations:
    """What the first of the recorded runs that has demonstrations was given, and its marks."""
    for run in runs:
        found: list[Trajectory] = []
        marks: list[TargetsMarked] = []
        for entry in journal_entries(run.path, "demonstration", "target"):
            match decode(entry.payload, Trajectory, TargetsMarked):
                case Trajectory() as trajectory:
                    found.append(trajectory)
                case TargetsMarked() as marked:
                    marks.append(marked)
        if found:
            return Demonstrations(tuple(found), tuple(marks) or None)
    return Demonstrations()


def train_from(
    folder: RunFolder,
    preset: Preset,
    episodes: RecordedEpisodes,
    demonstrations: Demonstrations | None,
    reward: Reward | None,
    compute: Compute,
    console: Console,
) -> bool:
    """Learns from recorded episodes into a run folder, or goes on with it.

    Returns:
        Whether all of them were learned from; False after Ctrl-C.
    """

    def make_actor(owner: Owner, _: SnapshotStore) -> AnsweringActor:
        return RecordedActor(owner, episodes, reward)

    def carry_out(progress: Progress) -> None:
        if not is_complete(folder):
            learn_in_process(folder, preset, compute, demonstrations, make_actor, progress)

    return conduct(folder, preset, compute, console, carry_out)


def compare_weights(folder: RunFolder, recorded: RecordedRun) -> Comparison:
    """Compares the policies of a run, by digest, with those of the recorded one."""
    with JournalReader(folder.journal) as journal:
        taken = [decode(it.payload, SnapshotTaken) for it in journal.entries("snapshot/")]
    mine = {it.version: it.digest for it in taken}
    both = sorted(mine.keys() & recorded.snapshot_digests.keys())
    same = [version for version in both if mine[version] == recorded.snapshot_digests[version]]
    return Comparison(tuple(same), tuple(version for version in both if version not in same))


def load_reward(name: str) -> Reward:
    """A function of a module of the user's own, `module:function`, also in the working folder.

    `task` stands for the rewards as they were recorded.

    Raises:
        PresetError: There is none.
    """
    if name == TASK_REWARD:
        return lambda trajectory: trajectory.rewards
    module_name, _, function_name = name.partition(":")
    if "" not in sys.path:
        sys.path.insert(0, "")  # an installed command does not look where it is started
    try:
        found = getattr(importlib.import_module(module_name), function_name)
    except (ImportError, AttributeError, ValueError) as error:
        raise PresetError(
            f"--reward: expected MODULE:FUNCTION that can be imported from here; got {name!r}: "
            f"{error}"
        ) from error
    if not callable(found):
        raise PresetError(f"--reward: expected a function; got {name!r}, {type(found).__name__}")
    reward: Reward = found
    return reward


def _checked(reward: Reward, trajectory: Trajectory) -> NDArray[np.float32]:
    given = np.asarray(reward(trajectory))
    if given.shape != (trajectory.steps,) or not np.isfinite(given).all():
        raise MessageError(
            f"--reward: expected {trajectory.steps} finite numbers, one for each step; got "
            f"{given.dtype} {list(given.shape)}"
        )
    return given.astype(np.float32)
