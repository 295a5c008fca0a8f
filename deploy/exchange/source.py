"""What is exported: the trajectories of a run, a recording or demonstrations, one at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from broker_config.codec import decode
from broker_config.errors import StorageError
from broker_config.journal import JOURNAL_FILE
from broker_config.messages import (
    DemonstrationsBegun,
    TargetsMarked,
    Trajectory,
    TrajectoryId,
)
from broker_config.preset import Preset, preset_from_json
from broker_config.recording.format import segment_paths
from deploy.offline.recorded_episodes import RecordedRun, journal_entries, source_paths
from learner.recorded import DEMONSTRATOR_PREFIX, TRAJECTORY_PREFIX

OnEntry = Callable[[], None]


@dataclass(frozen=True)
class MarkedTrajectory:
    """A trajectory, and what a person marked in it."""

    trajectory: Trajectory
    targets: tuple[int, ...] = ()
    """Which of its states are targets; none where nobody marked any."""


@dataclass(frozen=True)
class Source:
    """Trajectories in order; each is read when it is its turn."""

    path: Path
    """Of the folder."""
    preset: Preset
    """Whose task was played."""
    origin: DemonstrationsBegun | None
    """Who demonstrated; None for a run."""
    trajectories: int
    """How many there are."""
    left_out: int
    """Complete episodes behind a gap, which are not among them."""
    read: Callable[[], Iterator[MarkedTrajectory]]
    """Begins to read them."""

    def __iter__(self) -> Iterator[MarkedTrajectory]:
        return self.read()


def open_source(path: Path, on_entry: OnEntry = lambda: None) -> Source:
    """Reads what a folder holds, and leaves its pictures where they are.

    Args:
        path: A run folder, a recording's folder, or one of `clothbus demos make`.
        on_entry: Called for each entry that is read, to show progress.

    Raises:
        StorageError: It is none of them, is damaged or still being written, or holds no episode.
    """
    (path,) = source_paths([path])
    if (path / JOURNAL_FILE).is_file():
        return _run(path, on_entry)
    if not (path.is_dir() and segment_paths(path)):
        raise StorageError(
            f"{path}: expected a run folder, a recording or demonstrations; got none of them; "
            "name a folder of `clothbus run`, `record` or `demos make`"
        )
    first = next(journal_entries(path), None)
    if first is not None and first.name.startswith(DEMONSTRATOR_PREFIX):
        return _demonstrations(path, on_entry)
    return _run(path, on_entry)


def _run(path: Path, on_entry: OnEntry) -> Source:
    run = RecordedRun(path, lambda _: on_entry())

    def read() -> Iterator[MarkedTrajectory]:
        for index in range(run.episodes):
            yield from map(MarkedTrajectory, run.parts(index))

    return Source(path, run.preset, None, run.trajectories, run.left_out, read)


def _demonstrations(path: Path, on_entry: OnEntry) -> Source:
    origin: DemonstrationsBegun | None = None
    first_offset = count = 0
    targets: dict[TrajectoryId, tuple[int, ...]] = {}
    for entry in journal_entries(path, "demonstrator", "trajectory", "target"):
        on_entry()
        if entry.name.startswith(DEMONSTRATOR_PREFIX):  # what came before is void
            origin = decode(entry.payload, DemonstrationsBegun)
            first_offset, count = entry.offset, 0
            targets.clear()
        elif entry.name.startswith(TRAJECTORY_PREFIX):
            count += 1
        else:
            marked = decode(entry.payload, TargetsMarked)
            targets[marked.trajectory] = marked.states
    if origin is None or not count:
        raise StorageError(
            f"{path}: expected at least one demonstration; got none; make some with "
            "`clothbus demos make`"
        )

    def read() -> Iterator[MarkedTrajectory]:
        for entry in journal_entries(path, "trajectory"):
            if entry.offset > first_offset:
                trajectory = decode(entry.payload, Trajectory)
                yield MarkedTrajectory(trajectory, targets.get(trajectory.id, ()))

    return Source(path, preset_from_json(origin.preset_json), origin, count, 0, read)
