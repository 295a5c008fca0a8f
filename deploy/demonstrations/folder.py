"""A folder of demonstrations: a recording that grows by whole episodes, and by a person's marks.

It is what a recorder keeps of a run, without the run: segments of MCAP, mended after a crash, with
pictures for viewers. `learner.recorded` says which entries it has, and reads it.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from actors.views import views_of
from broker_config.closing import Closing
from broker_config.codec import encode
from broker_config.errors import PresetError, StorageError
from broker_config.journal import JOURNAL_FILE
from broker_config.messages import (
    DemonstrationsBegun,
    JournalEntry,
    RunStarted,
    TargetsMarked,
    Trajectory,
)
from broker_config.recording.format import segment_paths
from broker_config.recording.recording import Recording, lock_recording, mend_recording
from broker_config.recording.segment import to_ns
from learner.recorded import (
    DEMONSTRATOR_PREFIX,
    TARGET_PREFIX,
    Demonstrations,
    read_recorded,
    trajectory_name,
)

_RUN = "demonstrations"
"""What a recorder would call the run."""


class DemonstrationWriter(Closing):
    """Adds to a folder, for one process at a time; what is added is durable on return.

    It remembers nothing of what it has added.
    """

    def __init__(self, path: Path) -> None:
        """Takes the folder, and mends what a killed process left of it.

        Raises:
            AlreadyOwned: Another process adds to it.
            StorageError: It holds something else, is damaged, or cannot be written.
        """
        if (path / JOURNAL_FILE).exists():
            raise _foreign(path, "a run folder")
        self.path = path
        self._lock = lock_recording(path)
        self._recording: Recording | None = None
        self._incarnation = secrets.token_hex(8)
        self._views = 0
        self._is_sound = True
        try:
            with self._disk():
                mend_recording(path, _RUN)
        except BaseException:
            self._lock.close()
            raise

    def close(self) -> None:
        """Finishes the file, so that any reader of MCAP can open it; a second call does nothing."""
        recording, self._recording = self._recording, None
        try:
            if recording is not None and self._is_sound:
                with self._disk():
                    recording.finish()
        finally:
            if recording is not None:
                recording.close()
            self._lock.close()

    def begin(self, begun: DemonstrationsBegun) -> None:
        """Notes who demonstrates from here on; what came before is void.

        Raises:
            StorageError: The disk refuses.
        """
        self._add_entries([(f"{DEMONSTRATOR_PREFIX}{begun.draw}", begun)])

    def add(self, trajectory: Trajectory, seen_unix_secs: Sequence[float]) -> None:
        """Adds an episode, with pictures for viewers.

        Args:
            trajectory: The episode.
            seen_unix_secs: When each of its T + 1 observations was made, by the wall clock.

        Raises:
            StorageError: The disk refuses.
        """
        views = views_of(trajectory, seen_unix_secs, self._incarnation, self._views)
        with self._disk():
            for view in views:
                self._open().add_view(view, to_ns(view.unix_secs))
                self._views += 1
        self._add_entries([(trajectory_name(trajectory.id), trajectory)])

    def mark(self, marks: Sequence[TargetsMarked]) -> None:
        """Adds a person's word on demonstrations that are here.

        Raises:
            StorageError: The disk refuses.
        """
        first = self._open().next_offset
        self._add_entries(
            (f"{TARGET_PREFIX}{offset}", mark) for offset, mark in enumerate(marks, first)
        )

    def _add_entries(self, named: Iterable[tuple[str, object]]) -> None:
        with self._disk():
            recording = self._open()
            for name, message in named:
                entry = JournalEntry(recording.next_offset, name, encode(message), time.time())
                recording.add_entry(entry)
            recording.flush()

    def _open(self) -> Recording:
        if self._recording is None:
            with self._disk():
                self._recording = Recording(self.path, _RUN, self._incarnation)
        return self._recording

    @contextmanager
    def _disk(self) -> Iterator[None]:
        """After an error the file stays as it is on the disk; the next start mends it."""
        try:
            yield
        except OSError as error:
            self._is_sound = False
            raise StorageError(
                f"demonstrations {self.path}: expected a disk that can be written; got {error}; "
                "free space, and make them again: what is there is kept"
            ) from error


class DemonstrationFolder(DemonstrationWriter):
    """Adds to a folder, and has all that is in it in memory.

    Attributes:
        made: What is in it.
    """

    def __init__(self, path: Path) -> None:
        """Takes the folder, and reads it.

        Raises:
            AlreadyOwned: Another process adds to it.
            StorageError: It holds something else, is damaged, or cannot be written.
        """
        super().__init__(path)
        try:
            self.made = read_recorded(path) if segment_paths(path) else Demonstrations()
            if isinstance(self.made.origin, RunStarted):
                raise _foreign(path, "the recording of a run")
        except BaseException:
            self.close()
            raise

    def begin(self, begun: DemonstrationsBegun) -> None:
        """See `DemonstrationWriter`."""
        super().begin(begun)
        self.made = Demonstrations(origin=begun)

    def add(self, trajectory: Trajectory, seen_unix_secs: Sequence[float]) -> None:
        """See `DemonstrationWriter`."""
        super().add(trajectory, seen_unix_secs)
        self.made = replace(self.made, trajectories=(*self.made.trajectories, trajectory))

    def mark(self, marks: Sequence[TargetsMarked]) -> None:
        """See `DemonstrationWriter`; all of it or nothing.

        Raises:
            MessageError: A state is not there.
            StorageError: The disk refuses.
        """
        by_id = {mark.trajectory: mark for mark in (*(self.made.marks or ()), *marks)}
        given = tuple(mark for mark in by_id.values() if mark.states)
        made = replace(self.made, marks=given or None)  # refuses what is not there
        super().mark(marks)
        self.made = made


def label_targets(
    path: Path, states: Mapping[int, Collection[int]], *, clear: bool = False
) -> tuple[TargetsMarked, ...]:
    """Marks states of demonstrations as targets, all of them or none.

    Args:
        path: The folder.
        states: By episode, counted from 0, the states that are its targets: 1 to T. They replace
            what was marked in that episode.
        clear: Take back the marks of all other episodes.

    Returns:
        What is marked now.

    Raises:
        AlreadyOwned: Another process adds to the folder.
        PresetError: An episode or a state is not there.
        StorageError: There are no demonstrations, or the disk refuses.
    """
    if not (path.is_dir() and segment_paths(path)):
        raise _foreign(path, "none")
    with DemonstrationFolder(path) as folder:
        trajectories = folder.made.trajectories
        before = folder.made.marks or ()
        new = {}
        for episode, chosen in sorted(states.items()):
            trajectory = _episode(path, trajectories, episode)
            if not all(1 <= state <= trajectory.steps for state in chosen):
                raise PresetError(
                    f"{path}: expected states 1 to {trajectory.steps} of episode {episode}; got "
                    f"{', '.join(map(str, sorted(chosen)))}; see `clothbus demos show`"
                )
            new[trajectory.id] = TargetsMarked(trajectory.id, tuple(sorted(chosen)))
        if clear:
            taken_back = {mark.trajectory: TargetsMarked(mark.trajectory, ()) for mark in before}
            new = taken_back | new
        if changed := [mark for mark in new.values() if mark not in before]:
            folder.mark(changed)
        return folder.made.marks or ()


def _episode(path: Path, trajectories: Sequence[Trajectory], episode: int) -> Trajectory:
    if not 0 <= episode < len(trajectories):
        raise PresetError(
            f"{path}: expected an episode of the {len(trajectories)}, counted from 0; got "
            f"{episode}; see `clothbus demos show`"
        )
    return trajectories[episode]


def _foreign(path: Path, what: str) -> StorageError:
    return StorageError(
        f"{path}: expected a folder of `clothbus demos make`; got {what}; name another folder"
    )
