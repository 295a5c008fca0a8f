"""Reading finished segments by their index."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import (
    Channel,
    ChunkIndex,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from broker_config.codec import SCHEMA_VERSION
from broker_config.errors import StorageError
from broker_config.recording.format import (
    Excerpt,
    Facts,
    RecordedMessage,
    is_wanted,
    segment_paths,
)
from broker_config.recording.records import (
    FRAME,
    PROFILE_FIELD,
    DamagedSegment,
    ForeignFile,
    TornSegment,
    open_chunk,
    open_segment,
)
from broker_config.recording.segment import (
    EXCERPT_METADATA,
    FACTS_METADATA,
    SCHEMA_VERSION_FIELD,
)


def iter_recording(
    source: Path | Collection[Path],
    topics: Collection[str] | None = None,
) -> Iterator[RecordedMessage]:
    """The messages of a recording in the order in which they were written, a chunk in memory.

    Args:
        source: A recording's folder, or segments.
        topics: Which topics, of all if None; one that ends with `/` stands for all that begin so.

    Raises:
        StorageError: A segment is cut off, empty, damaged, or no clothbus recording, or there is
            none.
    """
    for path in segments_of(source):
        for _, channel, message in iter_segment(path, topics):
            yield recorded(channel, message)


def segments_of(source: Path | Collection[Path]) -> list[Path]:
    """The segments of a recording's folder, or what was given.

    Raises:
        StorageError: There is none, or one in the middle is missing.
    """
    paths = segment_paths(source) if isinstance(source, Path) and source.is_dir() else source
    paths = [paths] if isinstance(paths, Path) else list(paths)
    if not paths:
        raise StorageError(
            f"recording {source}: expected segments like 000000.mcap; got none; "
            "name the folder that a recorder wrote"
        )
    return paths


def iter_segment(
    path: Path,
    topics: Collection[str] | None = None,
    on_bytes: Callable[[int], None] = lambda _: None,
) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """The messages of a finished segment with what tells of them, a chunk in memory.

    Args:
        path: Of the segment.
        topics: As `iter_recording` has them; chunks without them are passed over.
        on_bytes: Told how many bytes of chunks have been read or passed since it was last told.

    Raises:
        StorageError: It is cut off, empty, damaged, or no clothbus recording.
    """
    with open_segment(path) as file:
        summary = read_summary(file, path)
        wanted = {id_: it for id_, it in summary.channels.items() if is_wanted(it.topic, topics)}
        for index in summary.chunk_indexes:
            if not wanted.keys().isdisjoint(index.message_index_offsets):
                for message in read_chunk(file, path, index):
                    if (channel := wanted.get(message.channel_id)) is not None:
                        yield summary.schemas.get(channel.schema_id), channel, message
            on_bytes(index.chunk_length)


def read_chunk(file: BinaryIO, path: Path, index: ChunkIndex) -> list[Message]:
    """The messages of a chunk that the index names.

    Raises:
        DamagedSegment: It is not there, or not as it was written.
    """
    at_byte = index.chunk_start_offset
    file.seek(at_byte)
    opcode, length = FRAME.unpack(file.read(FRAME.size).ljust(FRAME.size, b"\0"))
    if (opcode, length + FRAME.size) != (Opcode.CHUNK, index.chunk_length):
        raise DamagedSegment(path, f"no chunk at byte {at_byte}")
    records = open_chunk(path, at_byte, file.read(length))
    return [record for record in records if isinstance(record, Message)]


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


# What a segment says of itself -----------------------------------------------------------------


def read_facts(path: Path) -> Facts:
    """What a finished segment says of itself.

    Raises:
        TornSegment: It is not finished.
        StorageError: It is damaged, or no clothbus recording.
    """
    with open_segment(path) as file:
        summary = read_summary(file, path)
        try:
            return Facts.from_metadata(read_metadata(file, summary)[FACTS_METADATA])
        except (ValueError, KeyError, McapError, struct.error, OSError) as error:
            raise DamagedSegment(path, f"no facts ({error})") from error


def read_excerpt(path: Path) -> Excerpt | None:
    """What a finished segment was copied from; None if a recorder wrote it.

    Raises:
        TornSegment: It is not finished.
        StorageError: It is damaged, or no clothbus recording.
    """
    with open_segment(path) as file:
        summary = read_summary(file, path)
        try:
            metadata = read_metadata(file, summary).get(EXCERPT_METADATA)
            return None if metadata is None else Excerpt.from_metadata(metadata)
        except (ValueError, KeyError, McapError, struct.error, OSError) as error:
            raise DamagedSegment(path, f"no readable origin ({error})") from error


def read_metadata(file: BinaryIO, summary: Summary) -> dict[str, dict[str, str]]:
    """The MCAP metadata of a segment, by name."""
    found = {}
    for index in summary.metadata_indexes:
        file.seek(index.offset + FRAME.size)
        # The library asks for any stream; a file is one.
        metadata = Metadata.read(ReadDataStream(file))
        found[metadata.name] = metadata.metadata
    return found


def require_schema_version(path: Path, channels: Iterable[Channel]) -> None:
    """Refuses what another schema version wrote.

    Raises:
        StorageError: A channel is of another version.
    """
    for version in schema_versions(channels):
        if version != SCHEMA_VERSION:
            raise StorageError(
                f"recording {path}: expected schema version {SCHEMA_VERSION}, which this clothbus "
                f"reads; got {version}; use the clothbus version that wrote it (`clothbus info` "
                "names it)"
            )


def schema_versions(channels: Iterable[Channel]) -> list[int]:
    """The codec's versions that channels are of; pictures for viewers have none."""
    found = {it.metadata.get(SCHEMA_VERSION_FIELD) for it in channels}
    return sorted(int(version) for version in found if version is not None)


def read_summary(file: BinaryIO, path: Path) -> Summary:
    """The index at the end of a finished segment, checked against its checksum.

    Raises:
        TornSegment: There is none.
        ForeignFile: No recorder wrote it.
        DamagedSegment: It is damaged.
    """
    file.seek(0)
    head = file.read(MAGIC_SIZE + FRAME.size + len(PROFILE_FIELD))
    profile = head[MAGIC_SIZE + FRAME.size :]
    if not MCAP0_MAGIC.startswith(head[:MAGIC_SIZE]) or not PROFILE_FIELD.startswith(profile):
        raise ForeignFile(path)
    return read_index(file, path)


def read_index(file: BinaryIO, path: Path) -> Summary:
    """The same of a file whose beginning is not looked at.

    Raises:
        TornSegment: There is none.
        DamagedSegment: It is damaged.
    """
    size = os.fstat(file.fileno()).st_size
    tail_bytes = FOOTER_SIZE + MAGIC_SIZE
    file.seek(max(0, size - tail_bytes))
    tail = file.read(tail_bytes)
    if size < tail_bytes or not tail.endswith(MCAP0_MAGIC):
        raise TornSegment(path, size)
    start, _, checksum = struct.unpack_from("<QQI", tail, FRAME.size)
    if not MAGIC_SIZE <= start <= size - tail_bytes:
        raise DamagedSegment(path, "no index at its end")
    file.seek(start)
    section = file.read()
    if zlib.crc32(section[: -MAGIC_SIZE - 4]) != checksum:
        raise DamagedSegment(path, "a damaged index at its end")
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
        case Statistics():
            summary.statistics = record
        case ChunkIndex():
            summary.chunk_indexes.append(record)
        case MetadataIndex():
            summary.metadata_indexes.append(record)
