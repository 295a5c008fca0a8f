"""Copies what is whole of a truncated or damaged segment into a new file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from broker_config.codec import decode_any
from broker_config.durable import PARTIAL_SUFFIX, sync_folder
from broker_config.errors import DecodeError, SchemaMismatch, StorageError
from broker_config.messages import JournalEntry
from broker_config.recording.format import (
    MESSAGE_ENCODING,
    EntryTally,
    Excerpt,
    Facts,
    topic_of,
)
from broker_config.recording.reader import read_facts, read_summary
from broker_config.recording.records import open_segment
from broker_config.recording.scan import (
    Damage,
    DamageKind,
    ScannedMessage,
    WholeChunk,
    scan_segment,
)
from broker_config.recording.segment import SegmentWriter, channel_of


@dataclass
class Recovery:
    """What was kept of a segment, and what was lost."""

    messages: int = 0
    entries: list[tuple[int, int]] = field(default_factory=list)
    """Of the journal, as ranges: first and last."""
    damages: list[Damage] = field(default_factory=list)
    nameless: int = 0
    """Messages in whole chunks of which nothing says what they are."""
    missing: int | None = None
    """Messages that are lost, where the file's index can still be read."""

    def note_entry(self, offset: int) -> None:
        """Takes in the next journal entry that was kept."""
        if self.entries and self.entries[-1][1] + 1 == offset:
            self.entries[-1] = (self.entries[-1][0], offset)
        else:
            self.entries.append((offset, offset))

    @property
    def is_end_alone_lost(self) -> bool:
        """Whether all there was up to some point is kept, as a recorder keeps it when it mends."""
        return not self.nameless and all(it.kind is not DamageKind.LOST for it in self.damages)


def recover_segment(
    path: Path, output: Path, on_bytes: Callable[[int], None] = lambda _: None
) -> Recovery:
    """Writes a new, finished segment of all that is whole; the old one is not touched.

    Args:
        path: Of the segment.
        output: A file that is not there yet.
        on_bytes: Told how many bytes have been read since it was last told.

    Raises:
        StorageError: It is no clothbus recording, of another schema version, or nothing in it is
            whole; or the new file is there already, or cannot be written. Nothing is left behind.
    """
    refuse_existing(output)
    partial = output.with_name(output.name + PARTIAL_SUFFIX)
    refuse_existing(partial)
    try:
        recovery = _write(path, partial, on_bytes)
        if recovery.messages:
            refuse_existing(output)
            partial.rename(output)
            sync_folder(output.parent)
    except OSError as error:
        raise cannot_write(output, error) from error
    finally:
        partial.unlink(missing_ok=True)
    if not recovery.messages:
        raise StorageError(
            f"recording {path}: expected at least one whole message; got none; there is nothing "
            "to recover (the run's journal still has everything)"
        )
    return recovery


def refuse_existing(output: Path) -> None:
    """Refuses to write where something is already.

    Raises:
        StorageError: There is.
    """
    if output.exists() or output.is_symlink():
        raise StorageError(
            f"{output}: expected nothing there; got a file or folder, which is left as it is; "
            "choose another --output"
        )


def cannot_write(output: Path, error: OSError) -> StorageError:
    """The error for a place that refuses what is written."""
    return StorageError(
        f"{output}: expected disks that can be read and written; got {error}; look at "
        "them, or choose another --output"
    )


def _write(path: Path, partial: Path, on_bytes: Callable[[int], None]) -> Recovery:
    recovery, facts, tally = Recovery(), Facts(), EntryTally()
    facts.run = _run_of(path)
    segment = SegmentWriter(partial)
    try:
        for item in scan_segment(path, on_bytes, without_head=True):
            match item:
                case Damage():
                    recovery.damages.append(item)
                case WholeChunk():
                    for found in item.messages:
                        _copy(path, found, segment, recovery, facts, tally)
        recovery.missing = _missing(path, recovery.messages)
        segment.finish(facts, _excerpt(path, recovery, tally))
    finally:
        segment.close()
    return recovery


def _copy(
    path: Path,
    found: ScannedMessage,
    segment: SegmentWriter,
    recovery: Recovery,
    facts: Facts,
    tally: EntryTally,
) -> None:
    schema, channel = found.schema, found.channel
    message = None
    if channel is None or channel.message_encoding == MESSAGE_ENCODING:
        message = _decoded(path, found.message.data)
    if channel is None:
        topic = topic_of(message)
        if topic is None:
            recovery.nameless += 1
            return
        schema, channel = channel_of(topic, type(message).__name__)
    if isinstance(message, JournalEntry):
        recovery.note_entry(message.offset)
        tally.note(message.offset)
    facts.note(message)
    segment.copy(schema, channel, found.message)
    recovery.messages += 1


def _decoded(path: Path, payload: bytes) -> object:
    """The message; None if it is none of the contract, and then copied as it is."""
    try:
        return decode_any(payload)
    except SchemaMismatch as error:
        raise StorageError(
            f"recording {path}: expected a segment of this clothbus version; got another's "
            f"({error}); recover it with the clothbus version that wrote it"
        ) from error
    except DecodeError:
        return None


def _run_of(path: Path) -> str:
    """Whose recording it is, where the file's index can still be read."""
    try:
        return read_facts(path).run
    except StorageError:
        return ""  # its first message says so, if it is whole


def _missing(path: Path, kept: int) -> int | None:
    try:
        with open_segment(path) as file:
            statistics = read_summary(file, path).statistics
    except StorageError:
        return None
    return None if statistics is None else statistics.message_count - kept


def _excerpt(path: Path, recovery: Recovery, tally: EntryTally) -> Excerpt | None:
    """None for what a recorder may go on with."""
    if recovery.is_end_alone_lost:
        return None
    lost = [it for it in recovery.damages if it.kind is not DamageKind.CHANGED]
    part = "without " + ", ".join(f"bytes {it.at_byte} to {it.end_byte}" for it in lost)
    return Excerpt("recovery", path.name, part, None, tally.count, tally.digest)
