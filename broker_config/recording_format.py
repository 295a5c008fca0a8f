"""What a run's recording is made of: topics, what a message in it is, and what can be told from it.

A recording is a folder of segments, `000000.mcap`, `000001.mcap` and so on, each a whole MCAP file.
The order of messages is the order in the files: log times are the recorder's wall clock, which may
jump backwards.
"""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import dataclass, field
from pathlib import Path

from broker_config.codec import decode_any
from broker_config.errors import StorageError
from broker_config.messages import (
    JournalEntry,
    Metrics,
    RecorderStarted,
    RecordingGap,
    Snapshot,
    View,
)

PROFILE = "clothbus"
"""MCAP's profile in the header of every segment."""

MESSAGE_ENCODING = "msgpack"
"""Of messages that are the codec's; pictures for viewers are protobuf."""

IMAGE_SUFFIX = "/image"
SNAPSHOT_TOPIC = "snapshot"
PRESENCE_TOPIC = "presence"
GAP_TOPIC = "gap"
RECORDER_TOPIC = "recorder"

_SEGMENT_NAME = re.compile(r"(\d{6,})\.mcap")


def journal_topic(entry_name: str) -> str:
    """Under which topic a journal entry lies: entries of one sort share one."""
    return f"journal/{entry_name.partition('/')[0]}"


def metrics_topic(role: str, process_id: str) -> str:
    """Under which topic a process's numbers lie."""
    return f"metrics/{role}/{process_id}"


def view_topic(actor: str) -> str:
    """Under which topic an actor's views lie; with `IMAGE_SUFFIX`, its pictures for viewers."""
    return f"view/{actor}"


def policy_gap_key(version: int) -> str:
    """The key in the gap that notes a policy version whose weights were gone."""
    return f"policy/{version}"


def segment_path(folder: Path, number: int) -> Path:
    """The file of a segment."""
    return folder / f"{number:06d}.mcap"


def segment_paths(folder: Path) -> list[Path]:
    """The segments of a recording, oldest first.

    Raises:
        StorageError: One in the middle is missing, or the folder cannot be read.
    """
    try:
        found = {int(name[1]): path for path in folder.iterdir() if (name := _segment(path))}
    except OSError as error:
        raise StorageError(
            f"recording {folder}: expected a folder that can be read; got {error}; "
            "name the folder that a recorder wrote"
        ) from error
    numbers = sorted(found)
    for before, number in itertools.pairwise(numbers):
        if number != before + 1:
            raise StorageError(
                f"recording {folder}: expected segment {segment_path(folder, before + 1).name} "
                f"after {found[before].name}; got {found[number].name}; put the missing segments "
                "back, or record into another folder"
            )
    return [found[number] for number in numbers]


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
    """`msgpack`: the codec's; `protobuf`: a picture for viewers."""
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
            DecodeError: It is a picture for viewers, or damaged.
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
