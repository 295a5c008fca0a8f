"""Compares a run's recording with its journal."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from broker_config.codec import decode
from broker_config.journal import JournalReader
from broker_config.messages import (
    AttemptEnded,
    JournalEntry,
    RecordingGap,
    Snapshot,
    SnapshotTaken,
    Verdict,
)
from broker_config.recording.recording import iter_recording


@dataclass(frozen=True)
class RecordedAccount:
    """What a recording holds."""

    entries: int
    """Of the journal."""
    trajectories: int
    accepted: int
    """Attempts that entered the memory; a ticket that is issued again on a busy machine may bring a
    trajectory to spare."""
    snapshots: int
    """Policy versions with their weights."""
    missing_live: int
    """Views and metrics that were dropped, by the gaps."""
    topics: Counter[str]
    """Messages by topic."""
    segments: int


def settle_recording(folder: Path, journal_path: Path) -> RecordedAccount:
    """Matches a finished recording with the journal, and counts.

    Raises:
        AssertionError: A journal entry is missing, double, out of order or another, or a policy
            version lacks its weights, or has others.
        StorageError: The recording is not finished, or damaged.
    """
    topics: Counter[str] = Counter()
    weights: dict[int, str] = {}
    missing_live = entries = trajectories = accepted = 0
    with JournalReader(journal_path) as journal:
        expected = iter(journal)
        for item in iter_recording(folder):
            topics[item.topic] += 1
            if item.encoding != "msgpack":
                continue
            match item.decode():
                case JournalEntry() as entry:
                    assert entry == next(expected, None), f"entry {entries}: got {entry.offset}"
                    assert item.topic == f"journal/{entry.name.split('/')[0]}"
                    entries += 1
                    trajectories += entry.name.startswith("trajectory/")
                    accepted += _is_accepted(entry)
                    _check_weights(entry, weights)
                case Snapshot() as snapshot:
                    assert weights.get(snapshot.version) != snapshot.digest, "recorded twice"
                    weights[snapshot.version] = snapshot.digest
                case RecordingGap() as gap:
                    assert not gap.key.startswith("policy/"), f"no weights: {gap}"
                    missing_live += gap.missing
        assert next(expected, None) is None, f"{entries} of {journal.end_offset} are recorded"
    segments = len(list(folder.glob("*.mcap")))
    return RecordedAccount(
        entries, trajectories, accepted, len(weights), missing_live, topics, segments
    )


def _is_accepted(entry: JournalEntry) -> bool:
    if not entry.name.startswith("ended/"):
        return False
    return decode(entry.payload, AttemptEnded).verdict is Verdict.ACCEPTED


def _check_weights(entry: JournalEntry, weights: dict[int, str]) -> None:
    if entry.name.startswith("snapshot/"):
        taken = decode(entry.payload, SnapshotTaken)
        assert weights.get(taken.version) == taken.digest, f"version {taken.version}"
