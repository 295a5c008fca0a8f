"""What a run's recording is made of: topics, what a message in it is, and what can be told from it.

A recording is a folder of segments, `000000.mcap`, `000001.mcap` and so on, each a whole MCAP file.
The order of messages is the order in the files: log times are the recorder's wall clock, which may
jump backwards.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from broker_config.codec import decode_any
from broker_config.errors import StorageError
from broker_config.messages import (
    JournalEntry,
    Metrics,
    Presence,
    RecorderStarted,
    RecordingGap,
    Snapshot,
    View,
)

PROFILE = "clothbus"
"""MCAP's profile in the header of every segment."""

MESSAGE_ENCODING = "msgpack"
"""Of messages that are the codec's; what is for viewers is protobuf or ROS 2's `cdr`."""

IMAGE_SUFFIX = "/image"
ANNOTATIONS_SUFFIX = "/annotations"
REWARD_SUFFIX = "/reward"
SNAPSHOT_TOPIC = "snapshot"
PRESENCE_TOPIC = "presence"
GAP_TOPIC = "gap"
RECORDER_TOPIC = "recorder"
POLICY_GAP_PREFIX = "policy/"

JOURNAL_PREFIX = "journal/"
"""Of the topics of journal entries, one for each sort."""

VIEW_PREFIX = "view/"
METRICS_PREFIX = "metrics/"

_SEGMENT_NAME = re.compile(r"(\d{6,})\.mcap")


def journal_topic(entry_name: str) -> str:
    """Under which topic a journal entry lies: entries of one sort share one."""
    return f"{JOURNAL_PREFIX}{entry_name.partition('/')[0]}"


def metrics_topic(role: str, process_id: str) -> str:
    """Under which topic a process's numbers lie; with `/<name>`, each of them for viewers."""
    return f"{METRICS_PREFIX}{role}/{process_id}"


def view_topic(actor: str) -> str:
    """Under which topic an actor's views lie; with a suffix, what viewers make of them."""
    return f"{VIEW_PREFIX}{actor}"


def topic_of(message: object) -> str | None:
    """Under which topic a message of the contract lies; None if recordings have no such message."""
    match message:
        case JournalEntry():
            return journal_topic(message.name)
        case Snapshot():
            return SNAPSHOT_TOPIC
        case View():
            return view_topic(message.actor)
        case Metrics():
            return metrics_topic(message.role, message.id)
        case Presence():
            return PRESENCE_TOPIC
        case RecordingGap():
            return GAP_TOPIC
        case RecorderStarted():
            return RECORDER_TOPIC
        case _:
            return None


def is_wanted(topic: str, topics: Collection[str] | None) -> bool:
    """Whether a topic is among the chosen ones; all are if None."""
    if topics is None or topic in topics:
        return True
    return any(it.endswith("/") and topic.startswith(it) for it in topics)


def view_topic_of(topic: str) -> str | None:
    """The topic of the views that a topic for viewers is made of; None if it is of something else.

    `view/<actor>/image` and `robot/<actor>/joints` are of `view/<actor>`.
    """
    prefix, _, rest = topic.partition("/")
    actor, separator, _ = rest.partition("/")
    return view_topic(actor) if prefix in ("view", "robot") and separator else None


def joints_topic(actor: str) -> str:
    """Under which topic the joints of an actor's robot lie, for viewers."""
    return f"robot/{actor}/joints"


def policy_gap_key(version: int) -> str:
    """The key in the gap that notes a policy version whose weights were gone."""
    return f"{POLICY_GAP_PREFIX}{version}"


def segment_path(folder: Path, number: int) -> Path:
    """The file of a segment."""
    return folder / f"{number:06d}.mcap"


def segment_paths(folder: Path) -> list[Path]:
    """The segments of a recording, oldest first.

    Raises:
        StorageError: One in the middle is missing, or the folder cannot be read.
    """
    found = numbered_segments(folder)
    for before, number in itertools.pairwise(found):
        if number != before + 1:
            raise StorageError(
                f"recording {folder}: expected segment {segment_path(folder, before + 1).name} "
                f"after {found[before].name}; got {found[number].name}; put the missing segments "
                "back, or record into another folder"
            )
    return list(found.values())


def numbered_segments(folder: Path) -> dict[int, Path]:
    """The segments that there are, by number, oldest first.

    Raises:
        StorageError: The folder cannot be read.
    """
    try:
        found = {int(name[1]): path for path in folder.iterdir() if (name := _segment(path))}
    except OSError as error:
        raise StorageError(
            f"recording {folder}: expected a folder that can be read; got {error}; "
            "name the folder that a recorder wrote"
        ) from error
    return dict(sorted(found.items()))


def segment_number(path: Path) -> int:
    """The number in a segment's name."""
    return int(path.name.partition(".")[0])


def _segment(path: Path) -> re.Match[str] | None:
    return _SEGMENT_NAME.fullmatch(path.name)


@dataclass(frozen=True)
class RecordedMessage:
    """One message of a recording."""

    topic: str
    encoding: str
    """`msgpack`: the codec's; `protobuf` and `cdr`: for viewers."""
    sequence: int
    """Of a journal entry its offset, of metrics and views the sender's; modulo 2**32."""
    log_time_ns: int
    """When it was written, by the recorder's wall clock; never for ordering."""
    publish_time_ns: int
    """When it came to be, by the wall clock of its origin; never for ordering."""
    payload: bytes

    def decode(self) -> object:
        """The message of the contract.

        Raises:
            DecodeError: It is for viewers, or damaged.
            SchemaMismatch: It was written by another schema version.
        """
        return decode_any(self.payload)


@dataclass
class Facts:
    """What a recorder must know of what is recorded, to go on with it.

    A finished segment carries its own as MCAP metadata, so that nobody need read it whole.
    """

    run: str = ""
    first_offset: int = 0
    """The first journal entry that this segment could hold."""
    next_offset: int = 0
    """All journal entries before it are recorded, and before each the weights that it names."""
    snapshots: dict[int, str] = field(default_factory=dict)
    """Digest of the newest recorded weights, by policy version."""
    next_sequences: dict[str, int] = field(default_factory=dict)
    """One past the last sequence number, by topic and incarnation with a blank between."""

    def note(self, message: object) -> None:
        """Takes in one message of the contract, in the order of the recording."""
        match message:
            case RecorderStarted():
                self.run = message.run
                self.first_offset = self.next_offset = message.next_offset
            case JournalEntry():
                self.next_offset = message.offset + 1
            case Snapshot():
                self.snapshots[message.version] = message.digest
            case Metrics():
                topic = metrics_topic(message.role, message.id)
                self._note_sequence(topic, message.incarnation, message.sequence + 1)
            case View():
                topic = view_topic(message.actor)
                self._note_sequence(topic, message.incarnation, message.sequence + 1)
            case RecordingGap():
                end = message.first_missing + message.missing
                self._note_sequence(message.key, message.incarnation, end)
            case _:
                pass  # presence tells a recorder nothing that it would have to go on from

    def expected_sequence(self, topic: str, incarnation: str) -> int:
        """The number that the next message of a sender must have, or some were dropped."""
        return self.next_sequences.get(f"{topic} {incarnation}", 0)

    def go_on_with(self, later: Facts, subject: str) -> None:
        """Takes in the facts of the following segment.

        Raises:
            StorageError: It is of another run, or entries are missing in between.
        """
        if self.run and later.run != self.run:
            raise StorageError(
                f"{subject}: expected a recording of run {self.run}, as the segments before; got "
                f"one of {later.run}; move it to a folder of its own"
            )
        if self.run and later.first_offset != self.next_offset:
            raise StorageError(
                f"{subject}: expected to go on with journal entry {self.next_offset}; got "
                f"{later.first_offset}; a segment is missing or not of this recording, put it right"
            )
        if not self.run:
            self.first_offset = later.first_offset
        self.run = later.run
        self.next_offset = later.next_offset
        self.snapshots.update(later.snapshots)
        for key, end in later.next_sequences.items():
            self.next_sequences[key] = max(end, self.next_sequences.get(key, 0))

    def to_metadata(self) -> dict[str, str]:
        """As MCAP metadata holds it."""
        return {
            "run": self.run,
            "first_offset": str(self.first_offset),
            "next_offset": str(self.next_offset),
            "snapshots": json.dumps(self.snapshots),
            "next_sequences": json.dumps(self.next_sequences),
        }

    @classmethod
    def from_metadata(cls, metadata: dict[str, str]) -> Facts:
        """Reads it again.

        Raises:
            KeyError: A field is missing.
            ValueError: A field is none of ours.
        """
        snapshots = json.loads(metadata["snapshots"])
        return cls(
            metadata["run"],
            int(metadata["first_offset"]),
            int(metadata["next_offset"]),
            {int(version): str(digest) for version, digest in snapshots.items()},
            {str(key): int(end) for key, end in json.loads(metadata["next_sequences"]).items()},
        )

    def _note_sequence(self, topic: str, incarnation: str, end: int) -> None:
        key = f"{topic} {incarnation}"
        self.next_sequences[key] = max(end, self.next_sequences.get(key, 0))


class EntryTally:
    """Which journal entries were met, in constant memory."""

    def __init__(self) -> None:
        self.count = 0
        self._digest = hashlib.sha256()

    def note(self, offset: int) -> None:
        """Takes in the next entry."""
        self.count += 1
        self._digest.update(offset.to_bytes(8, "little"))

    @property
    def digest(self) -> str:
        """SHA-256 over the offsets, each as eight bytes, in order."""
        return self._digest.hexdigest()


ExcerptKind = Literal["slice", "recovery"]


@dataclass(frozen=True)
class Excerpt:
    """Where the messages of a segment come from that no recorder wrote.

    Entries of the journal may be missing from it, so that no recorder goes on with it.
    """

    kind: ExcerptKind
    source: str
    """Name of the file or folder."""
    part: str
    """Which part of it, for a person: episodes 3-7; without bytes 100 to 200."""
    topics: tuple[str, ...] | None
    """Of a slice: the chosen ones, all if None."""
    entries: int
    """Of the journal, in this segment."""
    entries_digest: str
    """Of their offsets, by `EntryTally`."""

    def to_metadata(self) -> dict[str, str]:
        """As MCAP metadata holds it."""
        return {
            "kind": self.kind,
            "source": self.source,
            "part": self.part,
            "topics": json.dumps(self.topics),
            "entries": str(self.entries),
            "entries_digest": self.entries_digest,
        }

    @classmethod
    def from_metadata(cls, metadata: dict[str, str]) -> Excerpt:
        """Reads it again.

        Raises:
            KeyError: A field is missing.
            ValueError: A field is none of ours.
        """
        topics = json.loads(metadata["topics"])
        return cls(
            "slice" if metadata["kind"] == "slice" else "recovery",
            metadata["source"],
            metadata["part"],
            None if topics is None else tuple(map(str, topics)),
            int(metadata["entries"]),
            metadata["entries_digest"],
        )
