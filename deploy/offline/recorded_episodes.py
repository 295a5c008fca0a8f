"""The episodes of recordings, in the order in which their runs learned from them.

A source is a run folder (its journal) or a recording's folder. Each is read twice: once for what
counts, and then from its beginning to its end as episodes are asked for, so that memory holds only
what arrived before its turn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from broker_config.codec import decode
from broker_config.errors import MessageError, PresetError, StorageError
from broker_config.journal import JOURNAL_FILE, JournalReader
from broker_config.messages import (
    AttemptEnded,
    JournalEntry,
    RunStarted,
    SnapshotTaken,
    Ticket,
    Trajectory,
    TrajectoryId,
    Verdict,
)
from broker_config.preset import Preset, TaskPreset, preset_from_json
from broker_config.recording.format import journal_topic
from broker_config.recording.recording import iter_recording
from deploy.count_progress import count_progress
from deploy.run_folder import RunFolder
from learner.recorded import trajectory_name


def source_paths(paths: Sequence[Path]) -> list[Path]:
    """Where the journals are: of a run folder the journal itself, and its recording without."""
    return [
        path / "recording"
        if (path / "recording").is_dir() and not RunFolder(path).journal.is_file()
        else path
        for path in paths
    ]


def journal_entries(source: Path, *sorts: str) -> Iterator[JournalEntry]:
    """The journal's entries of some sorts, in order, a batch in memory.

    Args:
        source: A run folder, or a recording's folder.
        sorts: What names begin with, before the first `/`; all if none is given.

    Raises:
        StorageError: It is neither, or damaged.
    """
    if (source / JOURNAL_FILE).is_file():
        with JournalReader(source / JOURNAL_FILE) as journal:
            for entry in journal:
                if not sorts or entry.name.partition("/")[0] in sorts:
                    yield entry
        return
    topics = [journal_topic(sort) for sort in sorts] if sorts else ["journal/"]
    for recorded in iter_recording(source, topics):
        message = recorded.decode()
        assert isinstance(message, JournalEntry)  # what these topics hold
        yield message


@dataclass
class _Contents:
    """What counts in a source."""

    preset: Preset | None = None
    parts: dict[int, list[TrajectoryId]] = field(default_factory=dict)
    """Accepted trajectories by ticket, in order."""
    complete: set[int] = field(default_factory=set)
    """Tickets."""
    snapshots: dict[int, str] = field(default_factory=dict)
    """Digests of policies' weights by version."""


class RecordedRun:
    """One source.

    Attributes:
        path: Of the source.
        preset: Of the run.
        episodes: How many there are from the first one on without a gap.
        left_out: Complete episodes behind a gap: the run ended before it had those between.
        snapshot_digests: Of the weights of its policies, by version.
    """

    def __init__(self, path: Path, on_entry: Callable[[JournalEntry], None] | None = None) -> None:
        """Reads what counts.

        Args:
            path: A run folder, or a recording's folder.
            on_entry: Told of each entry that is read, to show progress.

        Raises:
            StorageError: It is neither, or holds no episode.
        """
        self.path = path
        contents = _contents_of(path, on_entry or (lambda _: None))
        if contents.preset is None or 0 not in contents.complete:
            raise StorageError(
                f"{path}: expected a run with at least one whole episode; got none; name a run "
                "folder or a recording in which something was collected"
            )
        self.preset = contents.preset
        self.snapshot_digests = contents.snapshots
        n = 0
        while n in contents.complete:
            n += 1
        self.episodes = n
        self.left_out = len(contents.complete) - n
        self._parts = contents.parts
        self._ticket_of = {
            id_: ticket for ticket, ids in contents.parts.items() if ticket < n for id_ in ids
        }
        self._read: dict[TrajectoryId, Trajectory] = {}
        """Trajectories that came before their turn."""
        self._reading: Iterator[Trajectory] = iter(())
        self._next = n
        """Episodes before it were handed out; going back begins anew."""

    @property
    def ids(self) -> list[TrajectoryId]:
        """Of its episodes' trajectories, in their order."""
        return [id_ for index in range(self.episodes) for id_ in self._parts[index]]

    @property
    def trajectories(self) -> int:
        """How many its episodes have; each is at least one."""
        return len(self._ticket_of)

    def parts(self, index: int) -> list[Trajectory]:
        """The trajectories of an episode: one, or several where its actor died in between.

        Asked for in order, each costs only its own reading.

        Raises:
            StorageError: The source does not hold it.
        """
        if not 0 <= index < self.episodes:
            raise StorageError(
                f"{self.path}: expected an episode of 0 to {self.episodes - 1}; got {index}"
            )
        if index < self._next:
            self._reading, self._read = self._trajectories(), {}
        self._next = index + 1
        wanted = self._parts[index]
        while not all(id_ in self._read for id_ in wanted):
            trajectory = next(self._reading, None)
            if trajectory is None:
                raise StorageError(
                    f"{self.path}: expected all trajectories of episode {index}; got fewer; "
                    "`clothbus check` says what is missing"
                )
            self._read[trajectory.id] = trajectory
        ticket_of = self._ticket_of  # what was passed over is not asked for again
        self._read = {id_: it for id_, it in self._read.items() if ticket_of[id_] >= index}
        return [self._read.pop(id_) for id_ in wanted]

    def _trajectories(self) -> Iterator[Trajectory]:
        names = {trajectory_name(id_) for id_ in self._ticket_of}
        for entry in journal_entries(self.path, "trajectory"):
            if entry.name in names:
                yield decode(entry.payload, Trajectory)


class RecordedEpisodes:
    """The episodes of several sources, one source after the other."""

    def __init__(self, runs: Sequence[RecordedRun]) -> None:
        """Joins them.

        Raises:
            PresetError: Their tasks differ.
        """
        self.runs = tuple(runs)
        self._current: tuple[int, list[Trajectory]] | None = None
        for run in runs[1:]:
            require_same_task(run.preset.task, runs[0].preset.task, f"{run.path}")

    def __len__(self) -> int:
        return sum(run.episodes for run in self.runs)

    def parts(self, index: int) -> list[Trajectory]:
        """The trajectories of an episode, counted over all sources.

        Raises:
            StorageError: There are fewer.
        """
        run, its_index = self._place(index)
        return run.parts(its_index)

    def answer(self, ticket: Ticket) -> Trajectory:
        """What was recorded of a ticket's episode, or of the part that it is for.

        Raises:
            MessageError: The recorded episode has no such part, or one of more steps.
            StorageError: There are fewer episodes.
        """
        if self._current is None or self._current[0] != ticket.index:
            self._current = ticket.index, self.parts(ticket.index)
        parts = self._current[1]
        if ticket.part >= len(parts) or parts[ticket.part].steps > ticket.steps:
            got = [part.steps for part in parts]
            raise MessageError(
                f"episode {ticket.index}: expected part {ticket.part} of at most {ticket.steps} "
                f"steps; got recorded parts of {got}; another actor has delivered the beginning of "
                "this episode: let it finish"
            )
        return parts[ticket.part]

    def policy_digest(self, index: int, version: int) -> str | None:
        """Of the weights of a policy version of the run that an episode is of, if it is known."""
        run, _ = self._place(index)
        return run.snapshot_digests.get(version)

    def _place(self, index: int) -> tuple[RecordedRun, int]:
        its_index = index
        for run in self.runs:
            if its_index < run.episodes:
                return run, its_index
            its_index -= run.episodes
        raise StorageError(f"recordings: expected an episode below {len(self)}; got {index}")


def require_same_task(task: TaskPreset, recorded: TaskPreset, subject: str) -> None:
    """Refuses to mix tasks; options, such as a difficulty, may differ.

    Args:
        task: Of whoever joins.
        recorded: What was recorded.
        subject: For the error.

    Raises:
        PresetError: Environment, horizon, pictures or actions differ.
    """
    mine, theirs = replace(task, options={}), replace(recorded, options={})
    if mine != theirs:
        raise PresetError(
            f"{subject}: expected the task that was recorded, {_described(theirs)}; got "
            f"{_described(mine)}; what was recorded is of that task alone"
        )


def _described(task: TaskPreset) -> str:
    return (
        f"{task.environment} with {task.horizon} steps, pictures {list(task.observation_shape)} "
        f"and {task.n_actions} actions"
    )


def read_episodes(paths: Sequence[Path]) -> RecordedEpisodes:
    """Reads what counts in the sources, with a bar on a terminal.

    Raises:
        PresetError: Their tasks differ.
        StorageError: There are none, or one of them is no run's, is damaged, or holds no episode.
    """
    if not paths:
        raise StorageError(
            "recordings: expected at least one source; got none; name a run folder or a recording"
        )
    with count_progress("Reading what there is") as on_entry:
        return RecordedEpisodes([RecordedRun(path, lambda _: on_entry()) for path in paths])


def _contents_of(path: Path, on_entry: Callable[[JournalEntry], None]) -> _Contents:
    contents = _Contents()
    for entry in journal_entries(path, "run", "ended", "snapshot"):
        on_entry(entry)
        match decode(entry.payload, RunStarted, AttemptEnded, SnapshotTaken):
            case RunStarted() as started:
                contents.preset = preset_from_json(started.preset_json)
            case SnapshotTaken() as taken:
                contents.snapshots[taken.version] = taken.digest
            case AttemptEnded(verdict=Verdict.ACCEPTED, trajectory=TrajectoryId() as id_) as ended:
                contents.parts.setdefault(ended.ticket, []).append(id_)
                if ended.is_last_part:
                    contents.complete.add(ended.ticket)
            case AttemptEnded():
                pass
    return contents
