"""What is in a recording, from the indexes of its segments: nearly nothing of it is read."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Header, Schema
from mcap.stream_reader import MAGIC_SIZE
from mcap.summary import Summary

from broker_config.codec import SCHEMA_VERSION, decode, decode_any
from broker_config.errors import MessageError
from broker_config.messages import (
    JournalEntry,
    Presence,
    RecorderStarted,
    RecordingGap,
    RunStarted,
)
from broker_config.preset import preset_from_json
from broker_config.recording.format import (
    GAP_TOPIC,
    JOURNAL_PREFIX,
    MESSAGE_ENCODING,
    METRICS_PREFIX,
    PRESENCE_TOPIC,
    RECORDER_TOPIC,
    VIEW_PREFIX,
    Excerpt,
    Facts,
    journal_topic,
)
from broker_config.recording.reader import (
    iter_segment,
    read_chunk,
    read_excerpt,
    read_facts,
    read_summary,
    schema_versions,
    segments_of,
)
from broker_config.recording.records import FRAME, DamagedSegment, TornSegment, open_segment
from broker_config.recording.scan import (
    Damage,
    DamageKind,
    ScannedMessage,
    WholeChunk,
    scan_segment,
)
from broker_config.recording.segment import MESSAGE_FIELD, SCHEMA_VERSION_FIELD

_RUN_TOPIC = journal_topic("run/0")
_DETAILS = (RECORDER_TOPIC, GAP_TOPIC, PRESENCE_TOPIC, _RUN_TOPIC)
"""Small and few: these are read."""


@dataclass
class TopicInfo:
    """What lies under a topic."""

    message: str
    """The name of its type."""
    schema_version: int | None
    """None for pictures, which are protobuf."""
    count: int = 0
    first_offset: int | None = None
    """Of journal entries."""
    last_offset: int | None = None


@dataclass
class SegmentInfo:
    """One file."""

    name: str
    size_bytes: int
    is_finished: bool
    writer: str
    """The program that wrote it, with its version."""
    messages: int = 0
    first_ns: int | None = None
    """The earliest time of the recorder's clock."""
    last_ns: int | None = None
    topics: dict[str, TopicInfo] = field(default_factory=dict)
    schema_versions: list[int] = field(default_factory=list)
    excerpt: Excerpt | None = None
    """Where it was copied from, if no recorder wrote it."""


@dataclass
class RecordingInfo:
    """All of a recording; what is in messages only where they are of our schema version."""

    path: str
    segments: list[SegmentInfo] = field(default_factory=list)
    run: str = ""
    preset: str = ""
    preset_digest: str = ""
    software_versions: list[str] = field(default_factory=list)
    """Of the owners and recorders, as they came."""
    owner_starts: int = 0
    recorder_starts: int = 0
    processes: dict[str, int] = field(default_factory=dict)
    """Seen by presence, metrics or views, as role/id; how often each was started, as far as its
    metrics and views tell."""
    snapshots: list[int] = field(default_factory=list)
    """Policy versions with their weights."""
    gaps: dict[str, int] = field(default_factory=dict)
    """How many messages are known to be missing, by topic."""

    @property
    def size_bytes(self) -> int:
        """Of all segments."""
        return sum(it.size_bytes for it in self.segments)

    @property
    def messages(self) -> int:
        """In all segments."""
        return sum(it.messages for it in self.segments)

    @property
    def topics(self) -> dict[str, TopicInfo]:
        """Of all segments."""
        found: dict[str, TopicInfo] = {}
        for segment in self.segments:
            for topic, info in segment.topics.items():
                whole = found.setdefault(topic, TopicInfo(info.message, info.schema_version))
                whole.count += info.count
                if whole.first_offset is None:
                    whole.first_offset = info.first_offset
                if info.last_offset is not None:
                    whole.last_offset = info.last_offset
        return dict(sorted(found.items()))

    @property
    def is_readable(self) -> bool:
        """Whether all of it is of the schema version that this clothbus reads."""
        return all(it.schema_versions in ([], [SCHEMA_VERSION]) for it in self.segments)


def read_info(source: Path, on_bytes: Callable[[int], None] = lambda _: None) -> RecordingInfo:
    """Looks at every segment of a recording.

    A segment that is not finished has no index: it is read as far as it is whole.

    Args:
        source: A recording's folder, or a segment.
        on_bytes: Told how many bytes have been passed since it was last told.

    Raises:
        StorageError: A segment is damaged, missing, or no clothbus recording.
    """
    info, details = RecordingInfo(str(source)), _Details()
    for path in segments_of(source):
        try:
            segment = _read_finished(path, details)
            on_bytes(segment.size_bytes)
        except TornSegment:
            segment = _read_torn(path, details, on_bytes)
        info.segments.append(segment)
    details.tell(info)
    return info


class _Details:
    """Gathers what is told by messages and facts."""

    def __init__(self) -> None:
        self._facts: list[Facts] = []
        self._processes: dict[str, set[str]] = {}
        self._gaps: Counter[str] = Counter()
        self._run: RunStarted | None = None
        self._run_name = ""
        self._versions: dict[str, None] = {}
        self._owner_starts = 0
        self._recorder_lives: set[str] = set()

    def note(self, message: object) -> None:
        match message:
            case RecorderStarted():
                self._run_name = message.run
                self._recorder_lives.add(message.incarnation)
                self._versions[message.software_version] = None
            case RecordingGap():
                self._gaps[message.key] += message.missing
            case Presence():
                self._processes.setdefault(f"{message.role}/{message.id}", set())
            case JournalEntry() if journal_topic(message.name) == _RUN_TOPIC:
                self._run = decode(message.payload, RunStarted)
                self._run_name = self._run.run
                self._owner_starts += 1
                self._versions[self._run.software_version] = None
            case _:
                pass  # the index tells enough of all others

    def note_facts(self, facts: Facts) -> None:
        self._facts.append(facts)

    def tell(self, info: RecordingInfo) -> None:
        snapshots: set[int] = set()
        for facts in self._facts:
            snapshots.update(facts.snapshots)
            self._run_name = self._run_name or facts.run
            for sender in facts.next_sequences:
                topic, _, life = sender.partition(" ")
                if (process := _process_of(topic)) is not None:
                    self._processes.setdefault(process, set()).add(life)
        info.run = self._run_name
        info.snapshots = sorted(snapshots)
        info.gaps = dict(sorted(self._gaps.items()))
        info.processes = {name: len(lives) for name, lives in sorted(self._processes.items())}
        info.software_versions = list(self._versions)
        info.owner_starts = self._owner_starts
        info.recorder_starts = len(self._recorder_lives)
        if self._run is not None:
            preset = preset_from_json(self._run.preset_json)
            info.preset, info.preset_digest = preset.name, preset.digest


def _process_of(topic: str) -> str | None:
    """Role and id of who sent what lies under a topic."""
    if topic.startswith(METRICS_PREFIX):
        return topic.removeprefix(METRICS_PREFIX)
    return f"actor/{topic.removeprefix(VIEW_PREFIX)}" if topic.startswith(VIEW_PREFIX) else None


def _read_finished(path: Path, details: _Details) -> SegmentInfo:
    with open_segment(path) as file:
        summary = read_summary(file, path)
        statistics = summary.statistics
        if statistics is None:
            raise DamagedSegment(path, "no statistics at its end")
        segment = SegmentInfo(path.name, path.stat().st_size, True, _writer(file, path))
        segment.schema_versions = schema_versions(summary.channels.values())
        segment.messages = statistics.message_count
        if statistics.message_count:
            segment.first_ns = statistics.message_start_time
            segment.last_ns = statistics.message_end_time
        for id_, channel in summary.channels.items():
            schema = summary.schemas.get(channel.schema_id)
            topic = segment.topics.setdefault(channel.topic, _topic_info(channel, schema))
            topic.count += statistics.channel_message_counts.get(id_, 0)
        _find_offsets(file, path, summary, segment)
    segment.excerpt = read_excerpt(path)
    details.note_facts(read_facts(path))
    if segment.schema_versions == [SCHEMA_VERSION]:
        for _, _, message in iter_segment(path, _DETAILS):
            details.note(_decoded(path, message.data))
    return segment


def _find_offsets(file: BinaryIO, path: Path, summary: Summary, segment: SegmentInfo) -> None:
    """The first and last journal entry of each sort, from the first and last chunk with any."""
    sorts = {
        id_: it.topic for id_, it in summary.channels.items() if it.topic.startswith(JOURNAL_PREFIX)
    }
    wanted: set[int] = set()
    for id_ in sorts:
        chunks = [
            n for n, it in enumerate(summary.chunk_indexes) if id_ in it.message_index_offsets
        ]
        wanted.update(chunks[:1] + chunks[-1:])
    for number in sorted(wanted):
        for message in read_chunk(file, path, summary.chunk_indexes[number]):
            if (topic := sorts.get(message.channel_id)) is not None:
                _note_offset(segment.topics[topic], message.sequence)


def _note_offset(topic: TopicInfo, offset: int) -> None:
    if topic.first_offset is None:
        topic.first_offset = offset
    topic.last_offset = offset


def _read_torn(path: Path, details: _Details, on_bytes: Callable[[int], None]) -> SegmentInfo:
    with open_segment(path) as file:
        segment = SegmentInfo(path.name, path.stat().st_size, False, _writer(file, path))
    facts = Facts()
    channels: dict[int, Channel] = {}
    for item in scan_segment(path, on_bytes):
        if isinstance(item, Damage) and item.kind is DamageKind.LOST:
            raise DamagedSegment(path, item.what)
        if isinstance(item, WholeChunk):
            for found in item.messages:
                _count(segment, found)
                if found.channel is not None:
                    channels[found.channel.id] = found.channel
            segment.schema_versions = schema_versions(channels.values())
            if segment.schema_versions == [SCHEMA_VERSION]:
                for message in _messages_of_ours(path, item.messages):
                    facts.note(message)
                    details.note(message)
    details.note_facts(facts)
    return segment


def _count(segment: SegmentInfo, found: ScannedMessage) -> None:
    segment.messages += 1
    at_ns = found.message.log_time
    segment.first_ns = at_ns if segment.first_ns is None else min(segment.first_ns, at_ns)
    segment.last_ns = at_ns if segment.last_ns is None else max(segment.last_ns, at_ns)
    if (channel := found.channel) is not None:
        topic = segment.topics.setdefault(channel.topic, _topic_info(channel, found.schema))
        topic.count += 1
        if channel.topic.startswith(JOURNAL_PREFIX):
            _note_offset(topic, found.message.sequence)


def _messages_of_ours(path: Path, found: Iterable[ScannedMessage]) -> Iterable[object]:
    for it in found:
        if it.channel is not None and it.channel.message_encoding == MESSAGE_ENCODING:
            yield _decoded(path, it.message.data)


def _decoded(path: Path, payload: bytes) -> object:
    try:
        return decode_any(payload)
    except MessageError as error:
        raise DamagedSegment(path, f"a message that cannot be read ({error})") from error


def _topic_info(channel: Channel, schema: Schema | None) -> TopicInfo:
    version = channel.metadata.get(SCHEMA_VERSION_FIELD)
    name = channel.message_encoding if schema is None else schema.name
    return TopicInfo(
        channel.metadata.get(MESSAGE_FIELD, name), None if version is None else int(version)
    )


def _writer(file: BinaryIO, path: Path) -> str:
    file.seek(MAGIC_SIZE + FRAME.size)
    try:
        return str(Header.read(ReadDataStream(file)).library)
    except (McapError, struct.error, UnicodeDecodeError) as error:
        return f"unknown ({error})" if path.stat().st_size else "unknown"
