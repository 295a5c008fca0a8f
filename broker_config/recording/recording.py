"""The recording of a run: written by one recorder, continued by the next without a gap.

A journal entry that names a policy version comes after the version's weights. A file that was cut
off is whole up to some message: an entry in it has its weights, and the offset of the next entry
is all that the next recorder needs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from broker_config.closing import Closing
from broker_config.codec import decode_any, encode
from broker_config.durable import PARTIAL_SUFFIX, sync_folder
from broker_config.errors import ClothbusError, SchemaMismatch, StorageError
from broker_config.failpoints import Failpoint, reach
from broker_config.messages import (
    JournalEntry,
    Metrics,
    Presence,
    RecorderStarted,
    RecordingGap,
    Snapshot,
    View,
)
from broker_config.ownership import FileLock
from broker_config.recording.format import (
    GAP_TOPIC,
    MESSAGE_ENCODING,
    PRESENCE_TOPIC,
    RECORDER_TOPIC,
    SNAPSHOT_TOPIC,
    Facts,
    RecordedMessage,
    journal_topic,
    metrics_topic,
    policy_gap_key,
    segment_number,
    segment_path,
    segment_paths,
    view_topic,
)
from broker_config.recording.reader import iter_recording, read_excerpt, read_facts
from broker_config.recording.records import DamagedSegment, TornSegment
from broker_config.recording.scan import (
    Damage,
    DamageKind,
    ScannedMessage,
    WholeChunk,
    scan_segment,
)
from broker_config.recording.segment import SegmentWriter, to_ns
from broker_config.recording.viewers import shown_of_metrics, shown_of_view
from broker_config.version import VERSION

__all__ = ["RecordedMessage", "Recording", "iter_recording", "lock_recording", "mend_recording"]

SEGMENT_BYTES = 1 << 30
LOCK_FILE = "recorder.lock"


def lock_recording(folder: Path) -> FileLock:
    """Takes the folder for one recorder; hold the result for as long as there may be a `Recording`.

    Raises:
        AlreadyOwned: Another recorder has it.
        StorageError: The folder cannot be made or written.
    """
    return FileLock(folder / LOCK_FILE, f"recording {folder}")


class Recording(Closing):
    """Writes the recording of one run; for one thread.

    Whoever opens it has locked the folder. After an `OSError` it can only be closed; opening it
    again goes on after the last message that reached the disk.

    Attributes:
        held_offset: All journal entries before it are on the disk, with the weights they name.
        gaps: Runs of messages that were dropped, so far.
        written_bytes: Payloads so far.
    """

    def __init__(
        self,
        folder: Path,
        run: str,
        incarnation: str,
        segment_bytes: int = SEGMENT_BYTES,
        on_progress: Callable[[], None] = lambda: None,
    ) -> None:
        """Mends what the last recorder left, and begins a new segment.

        Args:
            folder: Of the recording; it exists.
            run: Whose.
            incarnation: Of this recorder.
            segment_bytes: A segment that has become larger is finished, and another begun.
            on_progress: Called now and then while a large segment is mended.

        Raises:
            StorageError: A segment is damaged, of another run, or no clothbus recording.
            OSError: The disk refuses.
        """
        self.folder = folder
        self._run = run
        self._incarnation = incarnation
        self._segment_bytes = segment_bytes
        self._facts, number = mend_recording(folder, run, on_progress)
        self.held_offset = self._facts.next_offset
        self.gaps = 0
        self.written_bytes = 0
        self._unflushed_bytes = 0
        self._begin(number)

    @property
    def next_offset(self) -> int:
        """The offset of the next journal entry."""
        return self._facts.next_offset

    @property
    def unflushed_bytes(self) -> int:
        """Payloads since the last flush."""
        return self._unflushed_bytes

    def has_snapshot(self, version: int, digest: str) -> bool:
        """Whether these weights are recorded."""
        return self._facts.snapshots.get(version) == digest

    def add_entry(self, entry: JournalEntry) -> None:
        """Adds the next journal entry; the weights that it names are there already.

        Raises:
            StorageError: It is not the next one.
            OSError: The disk refuses.
        """
        if entry.offset != self.next_offset:
            raise StorageError(
                f"recording {self.folder}: expected journal entry {self.next_offset}; got "
                f"{entry.offset}; the journal has a hole or the recorder is wrong: report it"
            )
        topic = journal_topic(entry.name)
        self._add(topic, entry, sequence=entry.offset, publish_time_ns=to_ns(entry.unix_secs))

    def add_snapshot(self, snapshot: Snapshot) -> None:
        """Adds the weights of a policy version.

        Raises:
            OSError: The disk refuses.
        """
        self._add(SNAPSHOT_TOPIC, snapshot, sequence=snapshot.version)

    def add_lost_snapshot(self, version: int) -> None:
        """Notes that the weights of a version are gone.

        Raises:
            OSError: The disk refuses.
        """
        self._add_gap(RecordingGap(policy_gap_key(version), self._incarnation, version, 1))

    def add_live(self, message: View | Metrics | Presence) -> None:
        """Adds a best-effort message, and before it a gap if its sequence number shows one.

        Raises:
            OSError: The disk refuses.
        """
        match message:
            case View():
                self.add_view(message)
            case Metrics():
                topic = metrics_topic(message.role, message.id)
                self._note_gap(topic, message)
                self._add(topic, message, message.sequence)
                for shown in shown_of_metrics(message):
                    self._segment.add_shown(shown, message.sequence)
            case Presence():
                self._add(PRESENCE_TOPIC, message)

    def add_view(self, view: View, log_time_ns: int | None = None) -> None:
        """Adds a view and what viewers see of it, and before them a gap if there is one.

        Args:
            view: What an actor saw.
            log_time_ns: When that was, where it was kept back since; the time of this call if None.
                Viewers play by it, and what belongs to a picture has the picture's.

        Raises:
            OSError: The disk refuses.
        """
        topic, unix_ns = view_topic(view.actor), to_ns(view.unix_secs)
        self._note_gap(topic, view)
        log_ns = time.time_ns() if log_time_ns is None else log_time_ns
        self._add(topic, view, view.sequence, unix_ns, log_ns)
        for shown in shown_of_view(view, unix_ns):
            self._segment.add_shown(shown, view.sequence, unix_ns, log_ns)

    def flush(self) -> None:
        """Makes everything so far durable, and begins another segment if this one is full.

        Raises:
            OSError: The disk refuses.
        """
        self._segment.flush()
        self.held_offset = self.next_offset
        self._unflushed_bytes = 0
        if self._segment.size_bytes > self._segment_bytes:
            self.finish()
            self._begin(segment_number(self._segment.path) + 1)

    def finish(self) -> None:
        """Finishes the segment, so that any MCAP reader can open it; durable on return.

        Raises:
            OSError: The disk refuses.
        """
        self._segment.finish(self._segment_facts)
        self._segment.close()
        self.held_offset = self.next_offset

    def close(self) -> None:
        """Closes the file as it is; a segment that is not finished is mended by the next start."""
        self._segment.close()

    def _begin(self, number: int) -> None:
        self._segment_facts = Facts()
        self._segment = SegmentWriter(segment_path(self.folder, number))
        started = RecorderStarted(self._run, self._incarnation, VERSION, self.next_offset)
        try:
            self._add(RECORDER_TOPIC, started)
            self._segment.flush()
        except BaseException:
            self._segment.close()
            raise

    def _note_gap(self, topic: str, message: View | Metrics) -> None:
        expected = self._facts.expected_sequence(topic, message.incarnation)
        if (missing := message.sequence - expected) > 0:
            self._add_gap(RecordingGap(topic, message.incarnation, expected, missing))

    def _add_gap(self, gap: RecordingGap) -> None:
        self._add(GAP_TOPIC, gap)
        self.gaps += 1

    def _add(
        self,
        topic: str,
        message: object,
        sequence: int = 0,
        publish_time_ns: int | None = None,
        log_time_ns: int | None = None,
    ) -> None:
        payload = encode(message)
        name = type(message).__name__
        self._segment.add(topic, name, payload, sequence, publish_time_ns, log_time_ns)
        self._facts.note(message)
        self._segment_facts.note(message)
        self.written_bytes += len(payload)
        self._unflushed_bytes += len(payload)


def mend_recording(
    folder: Path, run: str, on_progress: Callable[[], None] = lambda: None
) -> tuple[Facts, int]:
    """Makes whole what the last recorder left, so that all of it can be read.

    Whoever mends has locked the folder. Segments that are whole stay as they are.

    Args:
        folder: Of the recording.
        run: Whose it is.
        on_progress: Called now and then while a large segment is mended.

    Returns:
        What is recorded, and the number of the segment with which to go on.

    Raises:
        StorageError: A segment is damaged, of another run, or no clothbus recording.
        OSError: The disk refuses.
    """
    facts = Facts()
    paths = segment_paths(folder)
    for path in paths[:-1]:
        facts.go_on_with(_read_own_facts(path), str(path))
    number = segment_number(paths[-1]) + 1 if paths else 0
    if paths:
        last = _recover_newest(paths[-1], on_progress)
        if last is None:  # not one whole message in it: it is begun anew
            number -= 1
        else:
            facts.go_on_with(last, str(paths[-1]))
    if facts.run not in ("", run):
        raise StorageError(
            f"recording {folder}: expected one of run {run}; got one of {facts.run}; "
            "record into another folder"
        )
    segment_path(folder, number).unlink(missing_ok=True)
    return facts, number


def _recover_newest(path: Path, on_progress: Callable[[], None]) -> Facts | None:
    try:
        return _read_own_facts(path)
    except TornSegment:
        return _mend(path, on_progress)


def _read_own_facts(path: Path) -> Facts:
    """The facts of a segment that a recorder wrote: only behind its last entry all are there."""
    if (excerpt := read_excerpt(path)) is not None:
        raise StorageError(
            f"recording {path}: expected a segment that a recorder wrote; got a {excerpt.kind} of "
            f"{excerpt.source}; record into another folder"
        )
    return read_facts(path)


def _mend(path: Path, on_progress: Callable[[], None]) -> Facts | None:
    """Makes a finished segment of what is whole in a torn one; None if nothing is.

    Raises:
        StorageError: The file is damaged, or no clothbus recording.
        OSError: The disk refuses; the torn file is as it was.
    """
    partial = path.with_name(path.name + PARTIAL_SUFFIX)
    segment = SegmentWriter(partial)
    try:
        facts = _copy_whole(path, segment, on_progress)
        if facts is not None:
            segment.finish(facts)
    except BaseException:
        segment.close()
        partial.unlink(missing_ok=True)
        raise
    segment.close()
    if facts is None:
        partial.unlink()
        return None
    reach(Failpoint.RECORDING_RECOVERED)
    partial.replace(path)
    sync_folder(path.parent)
    return facts


def _copy_whole(
    path: Path, segment: SegmentWriter, on_progress: Callable[[], None]
) -> Facts | None:
    facts = Facts()
    is_empty = True
    for item in scan_segment(path):
        on_progress()
        match item:
            case Damage(DamageKind.LOST):
                raise DamagedSegment(path, item.what)
            case WholeChunk():
                for found in item.messages:
                    is_empty = False
                    _copy(path, found, segment, facts)
    return None if is_empty else facts


def _copy(path: Path, found: ScannedMessage, segment: SegmentWriter, facts: Facts) -> None:
    if found.channel is None:
        raise DamagedSegment(path, f"a message of channel {found.message.channel_id}, unheard of")
    if found.channel.message_encoding == MESSAGE_ENCODING:
        facts.note(_decoded(path, found.message.data))
    segment.copy(found.schema, found.channel, found.message)


def _decoded(path: Path, payload: bytes) -> object:
    try:
        return decode_any(payload)
    except SchemaMismatch as error:
        raise StorageError(
            f"recording {path}: expected a segment of this clothbus version; got another's, which "
            f"its recorder left unfinished ({error}); record with that version once more, or into "
            "another folder"
        ) from error
    except ClothbusError as error:
        raise DamagedSegment(path, f"a message that cannot be read ({error})") from error
