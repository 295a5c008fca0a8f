"""Cuts a part out of a recording, into a recording that can be read by itself.

The recording is read twice: first its journal alone, for what belongs together (`SlicePlan`), then
all of it, and what belongs to the part is copied as it is, with its times.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from mcap.records import Channel, Message, Schema

from broker_config.closing import Closing
from broker_config.codec import decode, decode_any, encode
from broker_config.durable import PARTIAL_SUFFIX, sync_folder
from broker_config.errors import MessageError, StorageError
from broker_config.messages import RecorderStarted, RecordingGap, View
from broker_config.recording.format import (
    GAP_TOPIC,
    JOURNAL_PREFIX,
    MESSAGE_ENCODING,
    RECORDER_TOPIC,
    SNAPSHOT_TOPIC,
    EntryTally,
    Excerpt,
    Facts,
    is_wanted,
    journal_topic,
    policy_gap_key,
    segment_path,
    view_topic_of,
)
from broker_config.recording.reader import (
    iter_segment,
    read_summary,
    require_schema_version,
    segments_of,
)
from broker_config.recording.records import DamagedSegment, open_segment
from broker_config.recording.recovery import cannot_write, refuse_existing
from broker_config.recording.segment import SegmentWriter, channel_of
from broker_config.recording.slice_plan import Selection, SlicePlan, plan_slice

SEGMENT_BYTES = 1 << 30


@dataclass
class Sliced:
    """What a slice holds."""

    messages: int = 0
    entries: int = 0
    """Of the journal."""
    segments: int = 0
    trajectories: int = 0


def slice_recording(
    source: Path,
    output: Path,
    selection: Selection,
    on_bytes: Callable[[int], None] = lambda _: None,
    segment_bytes: int = SEGMENT_BYTES,
) -> Sliced:
    """Writes a part of a recording into a new folder.

    Args:
        source: A recording's folder, or a segment.
        output: A folder that is not there yet.
        selection: Which part.
        on_bytes: Told how many bytes have been read since it was last told: twice those there are.
        segment_bytes: Size at which another file is begun.

    Raises:
        StorageError: The recording is damaged, not finished or of another schema version; the part
            is empty; or the new folder is there already, or cannot be written. Nothing is left.
    """
    refuse_existing(output)
    partial = output.with_name(output.name + PARTIAL_SUFFIX)
    refuse_existing(partial)
    paths = segments_of(source)
    for path in paths:
        with open_segment(path) as file:
            require_schema_version(path, read_summary(file, path).channels.values())
    plan = plan_slice(paths, selection, on_bytes)
    try:
        partial.mkdir(parents=True)
        sliced = _write(paths, partial, plan, on_bytes, segment_bytes, _name(source))
        refuse_existing(output)
        partial.rename(output)
        sync_folder(output.parent)
    except OSError as error:
        raise cannot_write(output, error) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return sliced


def _name(source: Path) -> str:
    """What it was cut from: a run folder's recording is named with its run."""
    return "/".join(source.resolve().parts[-2:])


def _write(
    paths: list[Path],
    folder: Path,
    plan: SlicePlan,
    on_bytes: Callable[[int], None],
    segment_bytes: int,
    source: str,
) -> Sliced:
    excerpt = Excerpt("slice", source, plan.selection.words, plan.selection.topics, 0, "")
    chooser = _Chooser(plan)
    with _SliceWriter(folder, _first_start(paths[0]), excerpt, segment_bytes) as writer:
        for path in paths:
            for schema, channel, message in iter_segment(path, None, on_bytes):
                heard = _decoded(path, channel, message)
                if chooser.is_kept(channel.topic, message, heard):
                    writer.add(schema, channel, message, heard)
        if not writer.sliced.messages:
            raise StorageError(
                f"slice of {source}: expected messages of {plan.selection.words}; got none; it "
                f"has {plan.there_is}"
            )
        writer.finish()
    return writer.sliced


def _decoded(path: Path, channel: Channel, message: Message) -> object | None:
    """The message; None of a journal entry, which the plan knows by its offset, and of pictures."""
    if channel.message_encoding != MESSAGE_ENCODING or channel.topic.startswith(JOURNAL_PREFIX):
        return None
    try:
        return decode_any(message.data)
    except MessageError as error:
        raise DamagedSegment(path, f"a message that cannot be read ({error})") from error


def _first_start(path: Path) -> RecorderStarted:
    for _, _, message in iter_segment(path, [RECORDER_TOPIC]):
        return decode(message.data, RecorderStarted)
    raise DamagedSegment(path, "no RecorderStarted as its first message")


class _Chooser:
    """Says of each message, in the order of the recording, whether it belongs to the part."""

    def __init__(self, plan: SlicePlan) -> None:
        self._plan = plan
        self._policy_gaps = {policy_gap_key(version) for version in plan.versions}
        self._is_within = False
        self._kept_views: dict[str, int] = {}

    def is_kept(self, topic: str, message: Message, heard: object | None) -> bool:
        plan = self._plan
        self._pass_entry(topic, message.sequence)
        if topic == RECORDER_TOPIC:
            return False  # each segment gets one of its own
        is_kept = self._belongs(topic, message, heard)
        if isinstance(heard, View) and is_kept:
            self._kept_views[topic] = heard.sequence
        return is_kept and is_wanted(topic, plan.selection.topics)

    def _pass_entry(self, topic: str, sequence: int) -> None:
        """What comes between the first and the last entry of the part is within it."""
        span = self._plan.span
        if span is not None and topic.startswith(JOURNAL_PREFIX):
            self._is_within = span[0] <= sequence < span[1]

    def _belongs(self, topic: str, message: Message, heard: object | None) -> bool:
        plan = self._plan
        if topic.startswith(JOURNAL_PREFIX) and message.sequence in plan.offsets:
            return True
        if topic == SNAPSHOT_TOPIC and message.sequence in plan.versions:
            return True
        if (
            topic == GAP_TOPIC
            and isinstance(heard, RecordingGap)
            and heard.key in self._policy_gaps
        ):
            return True
        if plan.window_ns is not None:
            return plan.window_ns[0] <= message.log_time < plan.window_ns[1]
        if isinstance(heard, View):
            return heard.ticket in plan.tickets
        if (of_views := view_topic_of(topic)) is not None:
            return self._kept_views.get(of_views) == message.sequence
        is_of_journal = topic.startswith(JOURNAL_PREFIX) or topic == SNAPSHOT_TOPIC
        return self._is_within and not is_of_journal


class _SliceWriter(Closing):
    """Writes the segments of a slice."""

    def __init__(
        self, folder: Path, start: RecorderStarted, excerpt: Excerpt, segment_bytes: int
    ) -> None:
        self.sliced = Sliced()
        self._folder = folder
        self._start = replace(start, next_offset=0)
        self._excerpt = excerpt
        self._segment_bytes = segment_bytes
        self._segment: SegmentWriter | None = None
        self._facts = Facts()
        self._tally = EntryTally()

    def add(
        self, schema: Schema | None, channel: Channel, message: Message, heard: object | None
    ) -> None:
        segment = self._segment_for(message)
        segment.copy(schema, channel, message)
        self.sliced.messages += 1
        if channel.topic.startswith(JOURNAL_PREFIX):
            self.sliced.entries += 1
            self.sliced.trajectories += channel.topic == journal_topic("trajectory")
            self._tally.note(message.sequence)
            self._facts.next_offset = message.sequence + 1
        elif heard is not None:
            self._facts.note(heard)

    def finish(self) -> None:
        if self._segment is not None:
            excerpt = replace(
                self._excerpt, entries=self._tally.count, entries_digest=self._tally.digest
            )
            self._segment.finish(self._facts, excerpt)
            self.close()

    def close(self) -> None:
        if self._segment is not None:
            self._segment.close()
            self._segment = None

    def _segment_for(self, message: Message) -> SegmentWriter:
        if self._segment is not None and self._segment.size_bytes > self._segment_bytes:
            self.finish()
        if self._segment is None:
            self._segment = self._begin(message.log_time)
        return self._segment

    def _begin(self, log_time_ns: int) -> SegmentWriter:
        start = replace(self._start, next_offset=self._facts.next_offset)
        self._facts, self._tally = Facts(), EntryTally()
        self._facts.note(start)
        segment = SegmentWriter(segment_path(self._folder, self.sliced.segments))
        self.sliced.segments += 1
        message = Message(0, log_time_ns, encode(start), log_time_ns, 0)
        segment.copy(*channel_of(RECORDER_TOPIC, "RecorderStarted"), message)
        return segment
