"""Whether a recording is whole: every byte of it is read once, a chunk in memory at a time."""

from __future__ import annotations

import struct
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from mcap.exceptions import McapError

from broker_config.codec import decode_any
from broker_config.errors import ClothbusError, MessageError, StorageError
from broker_config.journal import JournalReader
from broker_config.messages import (
    JournalEntry,
    Metrics,
    RecorderStarted,
    Rewards,
    Snapshot,
    Trajectory,
    View,
)
from broker_config.recording.findings import Extent, Finding, Heard, Rule
from broker_config.recording.format import (
    MESSAGE_ENCODING,
    EntryTally,
    Excerpt,
    Facts,
    numbered_segments,
    segment_path,
)
from broker_config.recording.reader import (
    read_excerpt,
    read_facts,
    read_summary,
    require_schema_version,
    segments_of,
)
from broker_config.recording.records import ForeignFile, open_segment
from broker_config.recording.rules import (
    EntriesInOrder,
    Placed,
    RecordersNamed,
    RewardsBelong,
    SameAsJournal,
    SendersCounted,
    TrajectoriesFit,
    WeightsThere,
    decode_entry,
)
from broker_config.recording.scan import (
    Damage,
    DamageKind,
    ScannedMessage,
    WholeChunk,
    scan_segment,
)
from broker_config.recording.segment import MESSAGE_FIELD, SEQUENCE_MODULUS, to_ns
from broker_config.recording.viewers import shown_of_metrics, shown_of_view


@dataclass
class Checked:
    """How much was read."""

    size_bytes: int = 0
    messages: int = 0
    entries: int = 0
    trajectories: int = 0
    snapshots: int = 0
    rewards: int = 0


class RecordingCheck:
    """One reading of a recording.

    Attributes:
        checked: How much was read so far.
    """

    def __init__(
        self,
        source: Path,
        journal: JournalReader | None = None,
        on_bytes: Callable[[int], None] = lambda _: None,
    ) -> None:
        """Prepares it.

        Args:
            source: A recording's folder, or a segment.
            journal: Of the run, to compare with.
            on_bytes: Told how many bytes have been read since it was last told.

        Raises:
            StorageError: There is no recording, or it is of another schema version.
        """
        self.checked = Checked()
        self._on_bytes = on_bytes
        self._missing, self._paths = _segments(source)
        is_folder = source.is_dir()
        extent = Extent(
            is_folder, is_folder or _begins_at_0(self._paths[0]), _slice_of(self._paths)
        )
        entries = EntriesInOrder(extent)
        self._rules: list[Rule] = [
            Placed(extent),
            RecordersNamed(extent),
            entries,
            WeightsThere(extent),
            TrajectoriesFit(extent),
            RewardsBelong(extent),
            SendersCounted(extent),
        ]
        if journal is not None:
            self._rules.append(SameAsJournal(extent, journal, entries))

    def findings(self) -> Iterator[Finding]:
        """Reads everything; faults and what else is worth knowing come as they are met.

        Raises:
            StorageError: A file cannot be read, or is of another schema version.
        """
        for path in self._missing:
            yield Finding(f"expected segment {path.name} in {path.parent}; it is not there")
        for path in self._paths:
            segment = _SegmentCheck(path, self._rules, self.checked)
            yield from segment.findings(self._on_bytes)
        for rule in self._rules:
            yield from rule.end()


class _SegmentCheck:
    def __init__(self, path: Path, rules: list[Rule], checked: Checked) -> None:
        self._path = path
        self._rules = rules
        self._checked = checked
        self._facts = Facts()
        self._tally = EntryTally()
        self._topics: Counter[str] = Counter()
        self._chunks: list[int] = []
        self._known_channels: set[int] = set()
        self._shown: dict[str, tuple[int, set[bytes]]] = {}
        """What viewers see of the newest view and metrics: sequence and payloads by topic."""
        self._is_sound = True
        self._is_first = True

    def findings(self, on_bytes: Callable[[int], None]) -> Iterator[Finding]:
        self._checked.size_bytes += self._path.stat().st_size
        try:
            self._refuse_other_schema()
            for item in scan_segment(self._path, on_bytes):
                if isinstance(item, Damage):
                    self._is_sound = False
                    yield self._damage(item)
                    continue
                self._chunks.append(item.at_byte)
                where = f"{self._path.name}, chunk at byte {item.at_byte}"
                for found in item.messages:
                    for finding in self._message(found):
                        yield replace(finding, where=where)
        except ForeignFile as error:
            yield Finding(str(error), where=self._path.name)
            return
        if self._is_sound:
            for finding in self._end():
                yield replace(finding, where=self._path.name)

    def _refuse_other_schema(self) -> None:
        try:
            with open_segment(self._path) as file:
                channels = read_summary(file, self._path).channels
        except StorageError:
            return  # each message says of itself
        require_schema_version(self._path, channels.values())

    def _damage(self, damage: Damage) -> Finding:
        expected = {
            DamageKind.LOST: "expected what its recorder wrote",
            DamageKind.CHANGED: "expected what its recorder wrote",
            DamageKind.CUT_OFF: "expected a finished segment",
        }[damage.kind]
        where = f"{self._path.name}, bytes {damage.at_byte} to {damage.end_byte}"
        return Finding(f"{expected}; got {damage.what}", where=where)

    # Messages ---------------------------------------------------------------------------------

    def _message(self, found: ScannedMessage) -> Iterator[Finding]:
        self._checked.messages += 1
        if (channel := found.channel) is None:
            yield Finding("expected a message of a known topic; what tells of its topic is lost")
            return
        if found.message.channel_id not in self._known_channels:
            require_schema_version(self._path, [channel])
            self._known_channels.add(found.message.channel_id)
        self._topics[channel.topic] += 1
        if channel.message_encoding != MESSAGE_ENCODING:
            yield from self._for_viewers(found, channel.topic)
            return
        try:
            message = decode_any(found.message.data)
        except MessageError as error:
            yield Finding(f"{channel.topic}: {error}")
            return
        expected = channel.metadata.get(MESSAGE_FIELD)
        if type(message).__name__ != expected:
            yield Finding(f"{channel.topic}: expected {expected}; got {type(message).__name__}")
        yield from self._first(message)
        yield from self._hear(message, channel.topic, found.message.sequence)

    def _first(self, message: object) -> Iterator[Finding]:
        if self._is_first and not isinstance(message, RecorderStarted):
            yield Finding(
                f"expected a segment that begins with RecorderStarted; got "
                f"{type(message).__name__} as its first message"
            )
        self._is_first = False

    def _hear(self, message: object, topic: str, sequence: int) -> Iterator[Finding]:
        entry = None
        if isinstance(message, JournalEntry):
            self._checked.entries += 1
            self._tally.note(message.offset)
            try:
                entry = decode_entry(message)
            except ClothbusError as error:
                yield Finding(f"journal entry {message.offset}, {message.name}: {error}")
        self._count(message, entry)
        self._facts.note(message)
        heard = Heard(message, entry, topic, sequence)
        for rule in self._rules:
            yield from rule.hear(heard)

    def _count(self, message: object, entry: object | None) -> None:
        self._checked.snapshots += isinstance(message, Snapshot)
        self._checked.trajectories += isinstance(entry, Trajectory)
        self._checked.rewards += isinstance(entry, Rewards)
        if isinstance(message, View | Metrics):
            self._note_shown(message)

    def _note_shown(self, message: View | Metrics) -> None:
        """What viewers see of a message comes right behind it."""
        shown: dict[str, set[bytes]] = defaultdict(set)
        made = (
            shown_of_view(message, to_ns(message.unix_secs))
            if isinstance(message, View)
            else shown_of_metrics(message)
        )
        for each in made:
            shown[each.topic].add(each.payload)
        for topic, payloads in shown.items():
            self._shown[topic] = message.sequence % SEQUENCE_MODULUS, payloads

    def _for_viewers(self, found: ScannedMessage, topic: str) -> Iterator[Finding]:
        """A message for viewers follows from the view or the metrics before it."""
        if (expected := self._shown.get(topic)) is None:
            return  # a slice may have these alone
        sequence, payloads = expected
        if found.message.sequence != sequence or found.message.data not in payloads:
            yield Finding(
                f"{topic}: expected what viewers see of message {sequence}; got something else, of "
                f"{found.message.sequence}"
            )

    # What the segment says of itself ----------------------------------------------------------

    def _end(self) -> Iterator[Finding]:
        with open_segment(self._path) as file:
            summary = read_summary(file, self._path)
        counts = summary.statistics.channel_message_counts if summary.statistics else {}
        told: Counter[str] = Counter()
        for id_, channel in summary.channels.items():
            told[channel.topic] += counts.get(id_, 0)
        for topic in sorted(told.keys() | self._topics.keys()):
            if told[topic] != self._topics[topic]:
                yield Finding(
                    f"{topic}: expected {told[topic]} messages, as the segment's index says; got "
                    f"{self._topics[topic]}"
                )
        if [it.chunk_start_offset for it in summary.chunk_indexes] != self._chunks:
            yield Finding("expected the chunks that the segment's index names; got others")
        yield from self._compare_with_metadata()

    def _compare_with_metadata(self) -> Iterator[Finding]:
        try:
            facts, excerpt = read_facts(self._path), read_excerpt(self._path)
        except (StorageError, McapError, struct.error) as error:
            yield Finding(str(error))
            return
        if excerpt is None:
            if facts != self._facts:
                yield Finding(f"expected facts {self._facts}, by its messages; got {facts}")
            return
        yield Finding(f"a {excerpt.kind} of {excerpt.source}: {excerpt.part}", is_fault=False)
        if (excerpt.entries, excerpt.entries_digest) != (self._tally.count, self._tally.digest):
            yield Finding(
                f"expected the {excerpt.entries} journal entries that were copied into it; got "
                f"{self._tally.count}, or others"
            )
        if excerpt.kind == "recovery":
            yield Finding(f"expected all of {excerpt.source}; got what was whole of it")


def _segments(source: Path) -> tuple[list[Path], list[Path]]:
    """The segments that are missing, and those that are there."""
    if not source.is_dir():
        return [], segments_of(source)
    found = numbered_segments(source)
    if not found:
        return [], segments_of(source)  # which says so
    missing = [segment_path(source, n) for n in range(max(found)) if n not in found]
    return missing, list(found.values())


def _slice_of(paths: list[Path]) -> Excerpt | None:
    for path in paths:
        try:
            excerpt = read_excerpt(path)
        except StorageError:
            continue  # what is wrong with it is found when it is read
        if excerpt is not None and excerpt.kind == "slice":
            return excerpt
    return None


def _begins_at_0(path: Path) -> bool:
    """Whether a segment by itself is a run's first."""
    try:
        for item in scan_segment(path):
            if isinstance(item, WholeChunk):
                first = decode_any(item.messages[0].message.data)
                return isinstance(first, RecorderStarted) and first.next_offset == 0
    except (ForeignFile, MessageError):
        pass  # found again, and told, when it is read
    return False
