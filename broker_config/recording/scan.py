"""Reads a segment from its first byte to its last, once, whatever state it is in.

What is damaged or cut off is told beside what is whole: `clothbus check` reports it, `clothbus
recover` goes on behind it, and a recorder that mends its newest segment stops at it.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import MAGIC_SIZE
from mcap.writer import MCAP0_MAGIC

from broker_config.codec import decode_any
from broker_config.errors import DecodeError, SchemaMismatch, StorageError
from broker_config.recording.format import RecordedMessage, is_wanted
from broker_config.recording.reader import iter_recording, read_index, recorded, segments_of
from broker_config.recording.records import (
    CHUNK_NAME_AT,
    FRAME,
    HEAD_BYTES,
    PROFILE_FIELD,
    DamagedSegment,
    ForeignFile,
    TornSegment,
    open_chunk,
    open_segment,
    what_is_wrong,
)

_ZSTD_FIELD = b"\x04\x00\x00\x00zstd"
"""In the head of each of our chunks; by it the next one is found behind damaged bytes."""

_SEARCH_BYTES = 4 << 20


class DamageKind(StrEnum):
    """What became of bytes that are not as they were written."""

    LOST = "lost"
    """They cannot be read."""
    CHANGED = "changed"
    """No message is in them."""
    CUT_OFF = "cut off"
    """They, or what should come after them, are not there."""


@dataclass(frozen=True)
class Damage:
    """Bytes of a segment that are not as they were written."""

    kind: DamageKind
    at_byte: int
    end_byte: int
    what: str
    """What was found instead of what was expected."""


@dataclass(frozen=True)
class ScannedMessage:
    """A message of a whole chunk."""

    message: Message
    channel: Channel | None
    """None if it was told of in bytes that are lost."""
    schema: Schema | None


@dataclass(frozen=True)
class WholeChunk:
    """A chunk whose checksum agrees."""

    at_byte: int
    messages: list[ScannedMessage]


def scan_segment(
    path: Path, on_bytes: Callable[[int], None] = lambda _: None, *, without_head: bool = False
) -> Iterator[WholeChunk | Damage]:
    """Everything in a segment, in the order of the file, a chunk in memory.

    Args:
        path: Of the segment.
        on_bytes: Told how many bytes have been passed since it was last told.
        without_head: Look for chunks of ours also in a file whose beginning is not ours.

    Raises:
        StorageError: It cannot be read.
        ForeignFile: It is no clothbus recording.
    """
    with open_segment(path) as file:
        yield from _Scan(path, file, on_bytes, without_head).items()


def iter_whole(
    source: Path | Collection[Path], topics: Collection[str] | None = None
) -> Iterator[RecordedMessage]:
    """The messages of a recording as `iter_recording` has them, also while it is written.

    A segment that is cut off, or not finished yet, is taken as far as it is whole.

    Raises:
        StorageError: A segment is damaged, or no clothbus recording, or there is none.
    """
    for path in segments_of(source):
        try:
            yield from iter_recording(path, topics)
        except TornSegment:
            yield from _iter_torn(path, topics)


def _iter_torn(path: Path, topics: Collection[str] | None) -> Iterator[RecordedMessage]:
    for item in scan_segment(path):
        if isinstance(item, Damage):
            if item.kind is not DamageKind.CUT_OFF:
                raise DamagedSegment(path, item.what)
            return
        for found in item.messages:
            if found.channel is not None and is_wanted(found.channel.topic, topics):
                yield recorded(found.channel, found.message)


class _Scan:
    def __init__(
        self, path: Path, file: BinaryIO, on_bytes: Callable[[int], None], without_head: bool
    ) -> None:
        self._path = path
        self._file = file
        self._on_bytes = on_bytes
        self._without_head = without_head
        self._size = os.fstat(file.fileno()).st_size
        self._position = 0
        self._checksum: int | None = 0
        """Of everything so far; None behind damage."""
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}

    def items(self) -> Iterator[WholeChunk | Damage]:
        yield from self._begin()
        is_first = self._position == MAGIC_SIZE
        while self._position < self._size:
            if (record := self._peek()) is None:
                break
            opcode, length, head = record
            end = self._position + FRAME.size + length
            wrong = what_is_wrong(opcode, length, head, is_first=is_first)
            if wrong is None and end > self._size:
                break
            if wrong is not None:
                yield self._skip(wrong)
                if self._position == self._size:
                    return
                continue
            content = self._take(length)
            match opcode:
                case Opcode.DATA_END:
                    yield from self._end(content)
                    return
                case Opcode.CHUNK:
                    yield self._open(content)
            self._pass(end)
            is_first = False
        yield self._cut_off()

    def _begin(self) -> Iterator[Damage]:
        """Passes the magic bytes, or what is damaged before the first chunk."""
        head = self._file.read(MAGIC_SIZE + FRAME.size + len(PROFILE_FIELD))
        self._learn_channels()
        profile = head[MAGIC_SIZE + FRAME.size :]
        is_ours = MCAP0_MAGIC.startswith(head[:MAGIC_SIZE]) and PROFILE_FIELD.startswith(profile)
        if is_ours:
            self._checksum = zlib.crc32(head[:MAGIC_SIZE])
            self._position = min(MAGIC_SIZE, self._size)
            return
        if not self._without_head:
            raise ForeignFile(self._path)
        damage = self._skip("another beginning")
        if not self._is_ours():
            raise ForeignFile(self._path)
        yield damage

    def _learn_channels(self) -> None:
        """From the index at the end, if there is one; the chunk that told of them may be lost."""
        try:
            summary = read_index(self._file, self._path)
        except StorageError:
            return
        self._schemas.update(summary.schemas)
        self._channels.update(summary.channels)

    def _peek(self) -> tuple[int, int, bytes] | None:
        """Opcode, length and head of the record here; None if the file ends before that."""
        self._file.seek(self._position)
        frame = self._file.read(FRAME.size)
        if len(frame) < FRAME.size:
            return None
        opcode, length = FRAME.unpack(frame)
        return opcode, length, self._file.read(min(length, HEAD_BYTES))

    def _take(self, length: int) -> bytes:
        """The content of the record here, which goes into the checksum."""
        self._file.seek(self._position)
        record = self._file.read(FRAME.size + length)
        if self._checksum is not None and record[0] != Opcode.DATA_END:
            self._checksum = zlib.crc32(record, self._checksum)
        return record[FRAME.size :]

    def _open(self, content: bytes) -> WholeChunk | Damage:
        try:
            records = open_chunk(self._path, self._position, content)
        except DamagedSegment as damage:
            end = self._position + FRAME.size + len(content)
            return Damage(DamageKind.LOST, self._position, end, damage.what)
        messages = []
        for record in records:
            match record:
                case Schema():
                    self._schemas[record.id] = record
                case Channel():
                    self._channels[record.id] = record
                case Message():
                    channel = self._channels.get(record.channel_id)
                    schema = self._schemas.get(channel.schema_id) if channel else None
                    messages.append(ScannedMessage(record, channel, schema))
        return WholeChunk(self._position, messages)

    def _end(self, data_end: bytes) -> Iterator[Damage]:
        """Of the data: its checksum, and the index behind it."""
        (written,) = struct.unpack("<I", data_end)
        if self._checksum is not None and written not in (0, self._checksum):
            what = "a checksum that does not agree with everything before it"
            yield Damage(DamageKind.CHANGED, 0, self._position, what)
        try:
            read_index(self._file, self._path)
        except TornSegment:
            yield self._cut_off()
        except DamagedSegment as damage:
            yield Damage(DamageKind.CHANGED, self._position, self._size, damage.what)
        self._pass(self._size)

    def _cut_off(self) -> Damage:
        what = f"the end of the file after {self._size} bytes"
        damage = Damage(DamageKind.CUT_OFF, self._position, self._size, what)
        self._pass(self._size)
        return damage

    def _skip(self, wrong: str) -> Damage:
        """Goes to the next sound chunk, or to the end of the file."""
        begin = self._position
        self._checksum = None
        self._pass(self._find_chunk(begin + 1))
        return Damage(DamageKind.LOST, begin, self._position, wrong)

    def _find_chunk(self, start: int) -> int:
        at, overlap = start, len(_ZSTD_FIELD) - 1
        while at + overlap < self._size:
            self._file.seek(at)
            block = self._file.read(_SEARCH_BYTES)
            hit = block.find(_ZSTD_FIELD)
            while hit >= 0:
                chunk = at + hit - CHUNK_NAME_AT - FRAME.size
                if chunk >= start and self._chunk_at(chunk) is not None:
                    return chunk
                hit = block.find(_ZSTD_FIELD, hit + 1)
            at += len(block) - overlap
        return self._size

    def _chunk_at(self, at: int) -> list[Schema | Channel | Message] | None:
        """The records of the chunk there, if there is a sound one."""
        self._file.seek(at)
        opcode, length = FRAME.unpack(self._file.read(FRAME.size))
        head = self._file.read(HEAD_BYTES)
        is_whole = at + FRAME.size + length <= self._size
        if opcode != Opcode.CHUNK or not is_whole:
            return None
        if what_is_wrong(opcode, length, head, is_first=False):
            return None
        self._file.seek(at + FRAME.size)
        try:
            return open_chunk(self._path, at, self._file.read(length))
        except DamagedSegment:
            return None

    def _is_ours(self) -> bool:
        """Whether a recorder wrote the chunk here."""
        if self._position == self._size:
            return False
        return any(
            isinstance(record, Message) and _is_message_of_ours(record.data)
            for record in self._chunk_at(self._position) or ()
        )

    def _pass(self, end: int) -> None:
        self._on_bytes(end - self._position)
        self._position = end


def _is_message_of_ours(payload: bytes) -> bool:
    try:
        decode_any(payload)
    except SchemaMismatch:
        return True  # of ours, and of another version
    except DecodeError:
        return False
    return True
