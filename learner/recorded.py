"""Reads what was recorded: the trajectories of a run that count, and demonstrations.

Demonstrations are a recording of their own (`clothbus demos make`), with these entries:

=============================  ================================================================
`demonstrator/<draw>`          `DemonstrationsBegun`
`trajectory/<id>`              `Trajectory`, one for each episode
`target/<offset>`              `TargetsMarked`, a person's; the last one for a trajectory counts
=============================  ================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from broker_config.codec import decode
from broker_config.errors import MessageError, StorageError
from broker_config.journal import JOURNAL_FILE, JournalReader
from broker_config.messages import (
    AttemptEnded,
    DemonstrationsBegun,
    JournalEntry,
    RunStarted,
    TargetsMarked,
    Trajectory,
    TrajectoryId,
    Verdict,
)
from broker_config.recording.format import journal_topic, segment_paths
from broker_config.recording.recording import iter_recording

DEMONSTRATOR_PREFIX = "demonstrator/"
TRAJECTORY_PREFIX = "trajectory/"
TARGET_PREFIX = "target/"


@dataclass(frozen=True)
class Demonstrations:
    """Trajectories to learn from, and what a person said of them."""

    trajectories: tuple[Trajectory, ...] = ()
    marks: tuple[TargetsMarked, ...] | None = None
    """Which states are targets: at most one for each trajectory. None where nobody marked any; what
    was marked and is not here is no mark, but not None either."""
    origin: DemonstrationsBegun | RunStarted | None = None
    """Who made them, and of which preset's task."""

    def __post_init__(self) -> None:
        steps = {each.id: each.steps for each in self.trajectories}
        for mark in self.marks or ():
            if mark.states[-1:] > (steps.get(mark.trajectory, 0),):
                raise MessageError(
                    f"demonstrations: expected marks of their own states; got {mark.states} of "
                    f"{mark.trajectory}; label them anew with `clothbus demos label`"
                )

    @property
    def samples(self) -> int:
        """Transitions in them."""
        return sum(each.steps for each in self.trajectories)


def trajectory_name(trajectory: TrajectoryId) -> str:
    """The journal's name of a trajectory."""
    return f"{TRAJECTORY_PREFIX}{trajectory}"


def accepted_trajectories(journal: JournalReader) -> Iterator[Trajectory]:
    """The trajectories of a journal that count, in order of tickets and parts."""
    for id_ in _accepted(journal.entries(prefix="ended/")):
        entry_or_none = journal.find(trajectory_name(id_))
        if entry_or_none is None:
            raise StorageError(f"journal: expected trajectory {id_}; it is not there")
        yield decode(entry_or_none.payload, Trajectory)


def read_demonstrations(path: Path) -> Demonstrations:
    """The demonstrations in a folder: of `clothbus demos make`, a run, or a run's recording.

    Of a run these are the trajectories that count.

    Raises:
        StorageError: It is none of them, is still being written, or cannot be read.
    """
    if (path / JOURNAL_FILE).is_file():
        with JournalReader(path / JOURNAL_FILE) as journal:
            (first, *_) = journal.entries(prefix="run/") or (None,)
            origin = None if first is None else decode(first.payload, RunStarted)
            return Demonstrations(tuple(accepted_trajectories(journal)), origin=origin)
    if path.is_dir() and segment_paths(path):
        return read_recorded(path)
    raise StorageError(
        f"{path}: expected demonstrations, a run folder or a run's recording; got none of them; "
        "make some with `clothbus demos make`"
    )


def read_recorded(folder: Path) -> Demonstrations:
    """The demonstrations in a recording: made as such, or a run's trajectories that count.

    Raises:
        StorageError: It is no recording, is still being written, or cannot be read.
    """
    first = next(_entries(folder, ""), None)
    if first is None:
        return Demonstrations()
    if first.name.startswith(DEMONSTRATOR_PREFIX):
        return _read_made(folder)
    wanted = list(_accepted(_entries(folder, "ended/")))
    names = {trajectory_name(id_) for id_ in wanted}
    found = {
        it.name: decode(it.payload, Trajectory)
        for it in _entries(folder, TRAJECTORY_PREFIX)
        if it.name in names
    }
    trajectories = tuple(found[trajectory_name(id_)] for id_ in wanted)
    return Demonstrations(trajectories, origin=decode(first.payload, RunStarted))


def _read_made(folder: Path) -> Demonstrations:
    made = Demonstrations()
    trajectories: list[Trajectory] = []
    marks: dict[TrajectoryId, TargetsMarked] = {}
    for entry in _entries(folder, DEMONSTRATOR_PREFIX, TRAJECTORY_PREFIX, TARGET_PREFIX):
        match decode(entry.payload, DemonstrationsBegun, Trajectory, TargetsMarked):
            case DemonstrationsBegun() as begun:
                made = Demonstrations(origin=begun)
                trajectories.clear()
                marks.clear()
            case Trajectory() as trajectory:
                trajectories.append(trajectory)
            case TargetsMarked() as marked:
                marks[marked.trajectory] = marked
    given = tuple(mark for mark in marks.values() if mark.states)
    return replace(made, trajectories=tuple(trajectories), marks=given or None)


def _accepted(ends: Iterable[JournalEntry]) -> Iterator[TrajectoryId]:
    """The trajectories that count, in order of tickets and parts."""
    accepted: list[tuple[int, int, TrajectoryId]] = []
    for entry in ends:
        ended = decode(entry.payload, AttemptEnded)
        if ended.verdict is Verdict.ACCEPTED and ended.trajectory is not None:
            accepted.append((ended.ticket, entry.offset, ended.trajectory))
    for _, _, trajectory in sorted(accepted, key=lambda item: item[:2]):
        yield trajectory


def _entries(folder: Path, *prefixes: str) -> Iterator[JournalEntry]:
    """The entries of a recorded journal whose names begin like one of these, in order."""
    topics = [journal_topic(prefix) for prefix in prefixes]
    for item in iter_recording(folder, topics):
        yield decode(item.payload, JournalEntry)


def first_samples(demonstrations: Demonstrations, samples: int) -> Demonstrations:
    """The trajectories that hold the first so many samples; the last of them is cut to fit.

    Marks of states that are cut off go with them.
    """
    kept = tuple(_first_samples(demonstrations.trajectories, samples))
    if demonstrations.marks is None:
        return replace(demonstrations, trajectories=kept)
    steps = {each.id: each.steps for each in kept}
    marks = (_marks_within(mark, steps.get(mark.trajectory, 0)) for mark in demonstrations.marks)
    return replace(
        demonstrations, trajectories=kept, marks=tuple(mark for mark in marks if mark.states)
    )


def _first_samples(trajectories: Sequence[Trajectory], samples: int) -> Iterator[Trajectory]:
    left = samples
    for each in trajectories:
        if left <= 0:
            return
        yield each if each.steps <= left else beginning(each, left)
        left -= each.steps


def _marks_within(marked: TargetsMarked, steps: int) -> TargetsMarked:
    return replace(marked, states=tuple(state for state in marked.states if state <= steps))


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
