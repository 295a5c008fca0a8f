"""How what was found in a recording is shown."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import RenderableType
from rich.table import Table

from broker_config.codec import SCHEMA_VERSION
from broker_config.recording.format import JOURNAL_PREFIX
from broker_config.recording.info import RecordingInfo, SegmentInfo
from broker_config.recording.recovery import Recovery


def info_tables(info: RecordingInfo) -> Iterator[RenderableType]:
    """What `clothbus info` prints."""
    yield _overview(info)
    yield _segments(info)
    yield _topics(info)


def info_json(info: RecordingInfo) -> dict[str, Any]:
    """The same for programs, with sums over all segments."""
    return {
        **asdict(info),
        "size_bytes": info.size_bytes,
        "messages": info.messages,
        "topics": {topic: asdict(it) for topic, it in info.topics.items()},
    }


def _overview(info: RecordingInfo) -> Table:
    table = Table(title=info.path, show_header=False, box=None, title_justify="left")
    entries = [it for topic, it in info.topics.items() if topic.startswith(JOURNAL_PREFIX)]
    rewards = info.topics.get(f"{JOURNAL_PREFIX}rewards")
    table.add_row("run", info.run or "unknown")
    table.add_row("preset", f"{info.preset} ({info.preset_digest[:12]})" if info.preset else "-")
    table.add_row("software", ", ".join(info.software_versions) or "-")
    writers = {_writer(segment): None for segment in info.segments}
    table.add_row("written by", "; ".join(writers))
    table.add_row("size", f"{info.size_bytes / 1e6:.1f} MB, {info.messages} messages")
    table.add_row("journal entries", str(sum(it.count for it in entries)))
    table.add_row("policy versions", _versions(info.snapshots))
    table.add_row("iterations rewarded", str(rewards.count if rewards else 0))
    table.add_row("starts", f"owner {info.owner_starts}, recorder {info.recorder_starts}")
    table.add_row("processes", _processes(info.processes))
    gaps = ", ".join(f"{key} {missing}" for key, missing in info.gaps.items())
    table.add_row("dropped, as noted", gaps or "nothing")
    for segment in info.segments:
        if (excerpt := segment.excerpt) is not None:
            table.add_row(segment.name, f"a {excerpt.kind} of {excerpt.source}: {excerpt.part}")
    if not info.is_readable:
        found = sorted({version for it in info.segments for version in it.schema_versions})
        table.add_row(
            "schema version",
            f"{', '.join(map(str, found))}; this clothbus reads {SCHEMA_VERSION}: what is in these "
            "messages is not shown",
        )
    return table


def _versions(versions: list[int]) -> str:
    return f"{len(versions)}, from {versions[0]} to {versions[-1]}" if versions else "0"


def _processes(processes: dict[str, int]) -> str:
    words = [f"{name} x{starts}" if starts > 1 else name for name, starts in processes.items()]
    return ", ".join(words) or "none"


def _segments(info: RecordingInfo) -> Table:
    table = Table("segment", "MB", "messages", "from", "to", "", box=None)
    for it in info.segments:
        state = "" if it.is_finished else "not finished"
        size = f"{it.size_bytes / 1e6:.1f}"
        table.add_row(it.name, size, str(it.messages), _time(it.first_ns), _time(it.last_ns), state)
    return table


def _writer(segment: SegmentInfo) -> str:
    versions = ", ".join(map(str, segment.schema_versions)) or "none"
    return f"{segment.writer}, schema version {versions}"


def _time(at_ns: int | None) -> str:
    if at_ns is None:
        return "-"
    at = datetime.datetime.fromtimestamp(at_ns / 1e9, datetime.UTC).astimezone()
    return at.strftime("%Y-%m-%d %H:%M:%S")


def _topics(info: RecordingInfo) -> Table:
    table = Table(box=None)
    table.add_column("topic", overflow="fold")
    for title in ("message", "count", "entries"):
        table.add_column(title)
    for topic, it in info.topics.items():
        entries = "" if it.first_offset is None else f"{it.first_offset} to {it.last_offset}"
        table.add_row(topic, it.message, str(it.count), entries)
    return table


def recovery_lines(file: Path, output: Path, recovery: Recovery) -> Iterator[str]:
    """What `clothbus recover` prints."""
    yield f"{output}: kept {recovery.messages} messages; journal entries {_entries(recovery)}"
    for damage in recovery.damages:
        where = f"{file.name}, bytes {damage.at_byte} to {damage.end_byte}"
        yield f"{damage.kind}: {where}: {damage.what}"
    for (_, before), (after, _) in zip(recovery.entries, recovery.entries[1:], strict=False):
        yield f"lost: journal entries {before + 1} to {after - 1}"
    if recovery.nameless:
        yield f"lost: {recovery.nameless} messages of which nothing says what they are"
    if recovery.missing:
        yield f"lost: {recovery.missing} messages in all, as the file's index says"
    if not recovery.damages and not recovery.nameless:
        yield f"nothing was lost: {file} is whole"


def _entries(recovery: Recovery) -> str:
    words = [
        f"{first} to {last}" if last > first else str(first) for first, last in recovery.entries
    ]
    return ", ".join(words) or "none"
