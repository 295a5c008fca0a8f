"""Where a report finds a run: its folder, or a recording of it alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Final, Protocol

from actors.policy import Policy
from broker_config.codec import decode
from broker_config.errors import StorageError
from broker_config.journal import JournalReader
from broker_config.messages import JournalEntry, RunStarted, Snapshot
from broker_config.preset import Preset, preset_from_json
from broker_config.recording.format import (
    GAP_TOPIC,
    MESSAGE_ENCODING,
    PRESENCE_TOPIC,
    RECORDER_TOPIC,
    SNAPSHOT_TOPIC,
    journal_topic,
    segment_paths,
)
from broker_config.recording.recording import RecordedMessage
from broker_config.recording.scan import iter_whole
from deploy.evaluation.scores import Score, read_results, scores_of
from deploy.run_folder import RunFolder
from learner.snapshots import SnapshotStore

_LIVE_TOPICS: Final = (PRESENCE_TOPIC, GAP_TOPIC, RECORDER_TOPIC, "metrics/")


class RunSource(Protocol):
    """What a report reads. Whatever it iterates over has a few messages in memory at a time."""

    @property
    def path(self) -> Path:
        """The folder that was named."""
        ...

    @property
    def preset(self) -> Preset:
        """Of the run."""
        ...

    @property
    def n_entries(self) -> int | None:
        """Of the journal; None where it takes a reading to know."""
        ...

    @property
    def missing(self) -> Sequence[str]:
        """What a report cannot say for want of a file, in words."""
        ...

    def entries(self) -> Iterator[JournalEntry]:
        """The journal, in order."""
        ...

    def live(self) -> Iterator[RecordedMessage]:
        """What a recorder has heard: metrics, presence, gaps, and its own starts; maybe nothing."""
        ...

    def evaluations(self) -> list[Score] | None:
        """Scores with their episodes; None where only metrics may tell."""
        ...

    def newest_policy(self) -> tuple[int, Policy] | None:
        """The newest policy that is there, and its version."""
        ...


def open_source(path: Path) -> RunSource:
    """Finds out what a folder is.

    Raises:
        StorageError: It is neither a run folder nor a recording.
    """
    if RunFolder(path).preset_file.exists():
        return FolderSource(RunFolder(path))
    if path.is_dir() and segment_paths(path):
        return RecordingSource(path)
    raise StorageError(
        f"{path}: expected a run folder (with preset.json) or a recording (with 000000.mcap); got "
        "neither; name a folder that `clothbus run` or `clothbus record` made"
    )


class FolderSource:
    """A run folder: the journal, and the recording in it if there is one."""

    def __init__(self, folder: RunFolder) -> None:
        """Opens the journal.

        Raises:
            PresetError: The preset is not of this version.
            StorageError: There is no journal, or it cannot be read.
        """
        self._folder = folder
        self.path = folder.path
        self.preset = folder.read_preset()
        with JournalReader(folder.journal) as journal:
            self.n_entries: int | None = journal.end_offset
        self._is_recorded = folder.recording.is_dir() and bool(segment_paths(folder.recording))

    @property
    def missing(self) -> Sequence[str]:
        """See `RunSource`."""
        if self._is_recorded:
            return ()
        return (
            "The run was not recorded: when evaluator and discriminators came and went, what the "
            "gradient steps alone took and which live messages were dropped is not known.",
        )

    def entries(self) -> Iterator[JournalEntry]:
        """See `RunSource`."""
        with JournalReader(self._folder.journal) as journal:
            yield from journal

    def live(self) -> Iterator[RecordedMessage]:
        """See `RunSource`."""
        if self._is_recorded:
            yield from _live_of(self._folder.recording)

    def evaluations(self) -> list[Score]:
        """See `RunSource`."""
        return scores_of(read_results(self._folder.evaluation), self.preset.seed)

    def newest_policy(self) -> tuple[int, Policy] | None:
        """See `RunSource`."""
        if not self._folder.snapshots.is_dir():
            return None
        store = SnapshotStore(self._folder.snapshots)
        for version in reversed(store.versions()):
            if (weights := store.get(version)) is not None:
                return version, Policy.from_bytes(self.preset.network, weights)
        return None


def _live_of(recording: Path) -> Iterator[RecordedMessage]:
    """Live messages as they were sent; what viewers make of them lies beside them."""
    for message in iter_whole(recording, _LIVE_TOPICS):
        if message.encoding == MESSAGE_ENCODING:
            yield message


class RecordingSource:
    """A recording's folder alone: a copy of the journal, and what was heard."""

    n_entries = None
    missing: Sequence[str] = (
        "This is made of a recording alone: evaluations are those that an evaluator has announced.",
    )

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def preset(self) -> Preset:
        """Of the run.

        Raises:
            StorageError: The recording does not say.
        """
        topics = [journal_topic("run/1")]
        for message in iter_whole(self.path, topics):
            entry = decode(message.payload, JournalEntry)
            return preset_from_json(decode(entry.payload, RunStarted).preset_json)
        raise StorageError(
            f"recording {self.path}: expected a run's first journal entry; got none; the recorder "
            "came no further than its start: let it record"
        )

    def entries(self) -> Iterator[JournalEntry]:
        """See `RunSource`."""
        for message in iter_whole(self.path, ["journal/"]):
            yield decode(message.payload, JournalEntry)

    def live(self) -> Iterator[RecordedMessage]:
        """See `RunSource`."""
        yield from _live_of(self.path)

    def evaluations(self) -> None:
        """See `RunSource`."""
        return

    def newest_policy(self) -> tuple[int, Policy] | None:
        """See `RunSource`."""
        newest: Snapshot | None = None
        for message in iter_whole(self.path, [SNAPSHOT_TOPIC]):
            found = decode(message.payload, Snapshot)
            if newest is None or found.version >= newest.version:
                newest = found
        if newest is None:
            return None
        return newest.version, Policy.from_bytes(newest.network, newest.weights)
