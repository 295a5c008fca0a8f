"""Reading recordings: finished segments by their index, torn ones as far as they are whole.

Every chunk is checked against its checksum and every record against its own lengths, so that a
damaged file is told from one that was cut off when its recorder died.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from broker_config.errors import StorageError
from broker_config.recording_format import PROFILE, Facts, RecordedMessage, segment_paths
from broker_config.recording_segment import FACTS_METADATA

_FRAME = struct.Struct("<BQ")
"""Opcode and length, before every record."""
_CHUNK_HEAD_BYTES = 32
"""Of a chunk's content, up to and with the length of the compression's name."""
_HEAD_BYTES = 64
"""As much of a record's content as its own lengths lie in."""
_LONGEST_NAME_BYTES = 8
_DATA_END_BYTES = 4
_MOST_RECORD_BYTES = 4 << 30
_PROFILE_FIELD = struct.pack("<I", len(PROFILE)) + PROFILE.encode()


class TornSegment(StorageError):
    """A segment that ends in the middle, as its recorder left it when it died."""

    def __init__(self, path: Path, size_bytes: int) -> None:
        super().__init__(
            f"recording {path}: expected a finished segment; got one that is cut off after "
            f"{size_bytes} bytes; its recorder still writes it, or mends it at its next start"
        )


def iter_recording(
    source: Path | Collection[Path], topics: Collection[str] | None = None
) -> Iterator[RecordedMessage]:
    """The messages of a recording in the order in which they were written, a chunk in memory.

    Args:
        source: A recording's folder, or segments.
        topics: Which topics, of all if None; one that ends with `/` stands for all that begin so.

    Raises:
        StorageError: A segment is cut off, empty, damaged, or no clothbus recording, or there is
            none.
    """
    paths = segment_paths(source) if isinstance(source, Path) and source.is_dir() else source
    paths = [paths] if isinstance(paths, Path) else list(paths)
    if not paths:
        raise StorageError(
            f"recording {source}: expected segments like 000000.mcap; got none; "
            "name the folder that a recorder wrote"
        )
    for path in paths:
        yield from _iter_segment(path, topics)


def read_facts(path: Path) -> Facts:
    """What a finished segment says of itself.

    Raises:
        TornSegment: It is not finished.
        StorageError: It is damaged, or no clothbus recording.
    """
    with _open(path) as file:
        summary = _read_summary(file, path)
        try:
            (index,) = (it for it in summary.metadata_indexes if it.name == FACTS_METADATA)
            file.seek(index.offset + _FRAME.size)
            metadata = Metadata.read(ReadDataStream(file))
            return Facts.from_metadata(metadata.metadata)
        except (ValueError, KeyError, McapError, struct.error, OSError) as error:
            raise damaged(path, f"no facts ({error})") from error


def scan_torn(path: Path) -> Iterator[Schema | Channel | Message]:
    """The whole records of a segment that is not finished, in order, a chunk in memory.

    It ends where the file is cut off.

    Raises:
        StorageError: The file is damaged before that, or no clothbus recording.
    """
    with _open(path) as file:
        size = os.fstat(file.fileno()).st_size
        if not MCAP0_MAGIC.startswith(file.read(MAGIC_SIZE)):
            raise _foreign(path)
        is_first = True
        while (frame := file.read(_FRAME.size)) and len(frame) == _FRAME.size:
            opcode, length = _FRAME.unpack(frame)
            start = file.tell()
            _check_lengths(path, opcode, length, file.read(_HEAD_BYTES), is_first=is_first)
            if opcode == Opcode.DATA_END or start + length > size:
                return  # what comes after the data follows from them
            file.seek(start)
            if opcode == Opcode.CHUNK:
                yield from _open_chunk(path, file)
            file.seek(start + length)
            is_first = False


def _check_lengths(path: Path, opcode: int, length: int, head: bytes, *, is_first: bool) -> None:
    """Tells a record that was cut off from one whose length is damaged.

    Both seem to go on after the end of the file; but only in the first case do the lengths within
    the record agree with its own.
    """
    if (opcode == Opcode.HEADER) != is_first:
        raise damaged(path, f"a record of kind {opcode} in a wrong place")
    match opcode:
        case Opcode.HEADER:
            if not _PROFILE_FIELD.startswith(head[: len(_PROFILE_FIELD)]):
                raise _foreign(path)
            is_sound = _agrees(head, len(_PROFILE_FIELD), len(_PROFILE_FIELD) + 4, length)
        case Opcode.CHUNK:
            is_sound = _is_sound_chunk(head, length)
        case Opcode.MESSAGE_INDEX:
            is_sound = _agrees(head, 2, 6, length)
        case Opcode.METADATA:
            is_sound = True  # facts, which follow from the messages
        case Opcode.DATA_END:
            is_sound = length == _DATA_END_BYTES
        case _:
            is_sound = False
    if not is_sound:
        raise damaged(path, f"a record of kind {opcode} with {length} bytes")


def _agrees(head: bytes, at: int, rest: int, length: int) -> bool:
    """Whether the u32 at an offset says how long the record is after `rest` bytes."""
    if len(head) < at + 4:
        return True  # cut off before it says so
    (size,) = struct.unpack_from("<I", head, at)
    return bool(length == rest + size)


def _is_sound_chunk(head: bytes, length: int) -> bool:
    if len(head) < _CHUNK_HEAD_BYTES:
        return True
    (name_bytes,) = struct.unpack_from("<I", head, _CHUNK_HEAD_BYTES - 4)
    if name_bytes > _LONGEST_NAME_BYTES:
        return False
    data_at = _CHUNK_HEAD_BYTES + name_bytes + 8
    if len(head) < data_at:
        return True
    (data_bytes,) = struct.unpack_from("<Q", head, data_at - 8)
    return bool(length == data_at + data_bytes)


def _open_chunk(path: Path, file: BinaryIO) -> Iterator[Schema | Channel | Message]:
    """The records of the chunk whose content begins here."""
    start = file.tell()
    try:
        chunk = Chunk.read(ReadDataStream(file))
        records = breakup_chunk(chunk, validate_crc=True)
    # The checks above the library's own leave it to fail on damaged bytes in any way.
    except Exception as error:
        raise damaged(path, f"a chunk at byte {start} that cannot be read ({error})") from error
    for record in records:
        if isinstance(record, Schema | Channel | Message):
            yield record


def _iter_segment(path: Path, topics: Collection[str] | None) -> Iterator[RecordedMessage]:
    with _open(path) as file:
        summary = _read_summary(file, path)
        wanted = {id_: it for id_, it in summary.channels.items() if _is_wanted(it.topic, topics)}
        for index in summary.chunk_indexes:
            if wanted.keys().isdisjoint(index.message_index_offsets):
                continue
            file.seek(index.chunk_start_offset)
            opcode, length = _FRAME.unpack(file.read(_FRAME.size).ljust(_FRAME.size, b"\0"))
            if (opcode, length + _FRAME.size) != (Opcode.CHUNK, index.chunk_length):
                raise damaged(path, f"no chunk at byte {index.chunk_start_offset}")
            for record in _open_chunk(path, file):
                if isinstance(record, Message) and record.channel_id in wanted:
                    yield recorded(wanted[record.channel_id], record)


def recorded(channel: Channel, message: Message) -> RecordedMessage:
    """A message as this module's users see it."""
    return RecordedMessage(
        channel.topic,
        channel.message_encoding,
        message.sequence,
        message.log_time,
        message.publish_time,
        message.data,
    )


def _is_wanted(topic: str, topics: Collection[str] | None) -> bool:
    if topics is None or topic in topics:
        return True
    return any(it.endswith("/") and topic.startswith(it) for it in topics)


def _read_summary(file: BinaryIO, path: Path) -> Summary:
    """The index at the end of a finished segment, checked against its checksum.

    Raises:
        TornSegment: There is none.
        StorageError: It is damaged, or the file is no clothbus recording.
    """
    size = os.fstat(file.fileno()).st_size
    head = file.read(MAGIC_SIZE + _FRAME.size + len(_PROFILE_FIELD))
    profile = head[MAGIC_SIZE + _FRAME.size :]
    if not MCAP0_MAGIC.startswith(head[:MAGIC_SIZE]) or not _PROFILE_FIELD.startswith(profile):
        raise _foreign(path)
    tail_bytes = FOOTER_SIZE + MAGIC_SIZE
    file.seek(max(0, size - tail_bytes))
    tail = file.read(tail_bytes)
    if size < tail_bytes or not tail.endswith(MCAP0_MAGIC):
        raise TornSegment(path, size)
    start, _, checksum = struct.unpack_from("<QQI", tail, _FRAME.size)
    if not MAGIC_SIZE <= start <= size - tail_bytes:
        raise damaged(path, "no index at its end")
    file.seek(start)
    section = file.read()
    if zlib.crc32(section[: -MAGIC_SIZE - 4]) != checksum:
        raise damaged(path, "a damaged index at its end")
    summary = Summary()
    for record in StreamReader(BytesIO(section), skip_magic=True).records:
        _take_up(summary, record)
    return summary


def _take_up(summary: Summary, record: McapRecord) -> None:
    match record:
        case Schema():
            summary.schemas[record.id] = record
        case Channel():
            summary.channels[record.id] = record
        case Footer():
            pass
        case _ if (indexes := _INDEXES.get(type(record).__name__)) is not None:
            getattr(summary, indexes).append(record)


_INDEXES = {"ChunkIndex": "chunk_indexes", "MetadataIndex": "metadata_indexes"}


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise StorageError(
            f"recording {path}: expected a segment that can be read; got {error}; "
            "check the path and its permissions"
        ) from error


def _foreign(path: Path) -> StorageError:
    return StorageError(
        f"recording {path}: expected a segment of a clothbus recording; got another file; "
        "move it away, or choose another folder"
    )


def damaged(path: Path, what: str) -> StorageError:
    """The error for a segment that was changed after it was written; nothing touches it."""
    return StorageError(
        f"recording {path}: expected a sound segment; got {what}; the file was damaged: move it to "
        "a safe place, and record into another folder (the run's journal still has everything)"
    )
