"""What a recorder notes of its own beside what it has heard; these never travel on the bus."""

from __future__ import annotations

from dataclasses import dataclass

from broker_config.messages.presence import Role
from broker_config.messages.rules import require_count, require_id


@dataclass(frozen=True)
class RecorderStarted:
    """Recording: a recorder began to write; the first message of every file."""

    run: str
    incarnation: str
    software_version: str
    next_offset: int
    """The first journal entry of this file; all before it are in earlier ones."""

    def __post_init__(self) -> None:
        require_id("recorder_started.run", self.run)
        require_id("recorder_started.incarnation", self.incarnation)
        require_count("recorder_started.next_offset", self.next_offset)


@dataclass(frozen=True)
class RecordingGap:
    """Recording: best-effort messages that were sent and are not here."""

    key: str
    incarnation: str
    """Of the sender."""
    first_missing: int
    """Its sequence number."""
    missing: int
    """How many in a row."""


@dataclass(frozen=True)
class Presence:
    """Recording: a process came or went."""

    role: Role
    id: str
    is_alive: bool
