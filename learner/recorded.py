"""Reads what an owner has recorded: the trajectories of a journal that count."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from broker_config.codec import decode
from broker_config.errors import StorageError
from broker_config.journal import JOURNAL_FILE, JournalReader
from broker_config.messages import AttemptEnded, Trajectory, TrajectoryId, Verdict


def trajectory_name(trajectory: TrajectoryId) -> str:
    """The journal's name of a trajectory."""
    return f"trajectory/{trajectory}"


def accepted_trajectories(journal: JournalReader) -> Iterator[Trajectory]:
    """The trajectories of a journal that count, in order of tickets and parts."""
    accepted: list[tuple[int, int, TrajectoryId]] = []
    for entry in journal.entries(prefix="ended/"):
        ended = decode(entry.payload, AttemptEnded)
        if ended.verdict is Verdict.ACCEPTED and ended.trajectory is not None:
            accepted.append((ended.ticket, entry.offset, ended.trajectory))
    for _, _, trajectory in sorted(accepted, key=lambda item: item[:2]):
        entry_or_none = journal.find(trajectory_name(trajectory))
        if entry_or_none is None:
            raise StorageError(f"journal: expected trajectory {trajectory}; it is not there")
        yield decode(entry_or_none.payload, Trajectory)


def read_demonstrations(folder: Path) -> list[Trajectory]:
    """The accepted trajectories of a folder that `clothbus collect` or a run has written.

    Raises:
        StorageError: There is no journal in it.
    """
    with JournalReader(folder / JOURNAL_FILE) as journal:
        return list(accepted_trajectories(journal))


def first_samples(trajectories: Iterable[Trajectory], samples: int) -> Iterator[Trajectory]:
    """The trajectories that hold the first so many samples; the last of them is cut to fit."""
    left = samples
    for each in trajectories:
        if left <= 0:
            return
        yield each if each.steps <= left else beginning(each, left)
        left -= each.steps


def beginning(trajectory: Trajectory, steps: int) -> Trajectory:
    """The first steps of a trajectory: it then ends without having terminated or succeeded."""
    return replace(
        trajectory,
        observations=trajectory.observations[: steps + 1],
        actions=trajectory.actions[:steps],
        rewards=trajectory.rewards[:steps],
        terminated=False,
        truncated=True,
        success=False,
    )
