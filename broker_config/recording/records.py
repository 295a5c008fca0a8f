"""The records of a segment as they lie in the file: lengths, chunks, and what tells damage.

Every chunk is checked against its checksum and every record against its own lengths, so that a
damaged file is told from one that was cut off when its recorder died.
"""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import breakup_chunk

from broker_config.errors import StorageError
from broker_config.recording.format import PROFILE

FRAME = struct.Struct("<BQ")
"""Opcode and length, before every record."""

HEAD_BYTES = 64
"""As much of a record's content as its own lengths lie in."""

CHUNK_NAME_AT = 28
"""Where in a chunk's content the length of the compression's name lies; the name follows."""

PROFILE_FIELD = struct.pack("<I", len(PROFILE)) + PROFILE.encode()
"""What the content of a header begins with."""

_LONGEST_NAME_BYTES = 8
_DATA_END_BYTES = 4
_MOST_METADATA_BYTES = 64 << 20
"""Facts of some 700,000 policy versions; their checksum is that of all data."""


def open_segment(path: Path) -> BinaryIO:
    """Opens a segment for reading.

    Raises:
        StorageError: It cannot be read.
    """
    try:
        return path.open("rb")
    except OSError as error:
        raise StorageError(
            f"recording {path}: expected a segment that can be read; got {error}; "
            "check the path and its permissions"
        ) from error


def what_is_wrong(opcode: int, length: int, head: bytes, *, is_first: bool) -> str | None:
    """Tells a record that was cut off from one whose length is damaged.

    Both seem to go on after the end of the file; but only in the first case do the lengths within
    the record agree with its own.

    Args:
        opcode: What the record says it is.
        length: Of its content, as it says.
        head: As much of its content as there is, `HEAD_BYTES` at most.
        is_first: Whether it is the file's first record, which must be its header.
    """
    if (opcode == Opcode.HEADER) != is_first:
        return f"a record of kind {opcode} in a wrong place"
    match opcode:
        case Opcode.HEADER:
            is_sound = _agrees(head, len(PROFILE_FIELD), len(PROFILE_FIELD) + 4, length)
        case Opcode.CHUNK:
            is_sound = _is_sound_chunk(head, length)
        case Opcode.MESSAGE_INDEX:
            is_sound = _agrees(head, 2, 6, length)
        case Opcode.METADATA:
            is_sound = length <= _MOST_METADATA_BYTES
        case Opcode.DATA_END:
            is_sound = length == _DATA_END_BYTES
        case _:
            is_sound = False
    return None if is_sound else f"a record of kind {opcode} with {length} bytes"


def _agrees(head: bytes, at: int, rest: int, length: int) -> bool:
    """Whether the u32 at an offset says how long the record is after `rest` bytes."""
    if len(head) < at + 4:
        return True  # cut off before it says so
    (size,) = struct.unpack_from("<I", head, at)
    return bool(length == rest + size)


def _is_sound_chunk(head: bytes, length: int) -> bool:
    name_at = CHUNK_NAME_AT + 4
    if len(head) < name_at:
        return True
    (name_bytes,) = struct.unpack_from("<I", head, CHUNK_NAME_AT)
    if name_bytes > _LONGEST_NAME_BYTES:
        return False
    data_at = name_at + name_bytes + 8
    if len(head) < data_at:
        return True
    (data_bytes,) = struct.unpack_from("<Q", head, data_at - 8)
    return bool(length == data_at + data_bytes)


def open_chunk(path: Path, at_byte: int, content: bytes) -> list[Schema | Channel | Message]:
    """The records of a chunk.

    Raises:
        DamagedSegment: It is not as it was written.
    """
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(content)))
        records = breakup_chunk(chunk, validate_crc=True)
    # The checks above the library's own leave it to fail on damaged bytes in any way.
    except Exception as error:
        what = f"a chunk at byte {at_byte} that cannot be read ({error})"
        raise DamagedSegment(path, what) from error
    return [record for record in records if isinstance(record, Schema | Channel | Message)]


class TornSegment(StorageError):
    """A segment that ends in the middle, as its recorder left it when it died."""

    def __init__(self, path: Path, size_bytes: int) -> None:
        super().__init__(
            f"recording {path}: expected a finished segment; got one that is cut off after "
            f"{size_bytes} bytes; its recorder still writes it, or mends it at its next start; "
            "`clothbus recover` copies what is whole of it"
        )


class ForeignFile(StorageError):
    """A file that no recorder wrote."""

    def __init__(self, path: Path) -> None:
        super().__init__(
            f"recording {path}: expected a segment of a clothbus recording; got another file; "
            "move it away, or choose another folder"
        )


class DamagedSegment(StorageError):
    """A segment that was changed after it was written; nothing touches it."""

    def __init__(self, path: Path, what: str) -> None:
        self.what = what
        super().__init__(
            f"recording {path}: expected a sound segment; got {what}; the file was damaged: keep "
            "it, `clothbus recover` copies what is whole of it; record into another folder (the "
            "run's journal still has everything)"
        )
