"""The journal: how followers pull it, and the entries that are no messages by themselves."""

from __future__ import annotations

from dataclasses import dataclass

from broker_config.messages.presence import Role
from broker_config.messages.rules import require, require_count, require_id
from broker_config.messages.tickets import Ticket
from broker_config.messages.trajectories import TrajectoryId, Verdict


@dataclass(frozen=True)
class JournalRequest:
    """A follower asks for the entries from an offset on."""

    role: Role
    id: str
    incarnation: str
    offset: int
    held_offset: int
    """All entries before it, and the snapshots they name, are on the follower's own disk."""
    max_bytes: int
    """A batch ends before it is larger than this, but holds one entry if there is any."""

    def __post_init__(self) -> None:
        require_id("journal_request.id", self.id)
        require_id("journal_request.incarnation", self.incarnation)
        require_count("journal_request.offset", self.offset)
        require_count("journal_request.held_offset", self.held_offset)
        require(self.max_bytes >= 1, "journal_request.max_bytes", "at least 1", self.max_bytes)


@dataclass(frozen=True)
class JournalEntry:
    """One entry of the journal as it is stored."""

    offset: int
    name: str
    """Unique in the journal; appending the same name again adds nothing."""
    payload: bytes
    """An encoded message."""
    unix_secs: float
    """Wall clock of the owner's host at the commit; for people, never for ordering."""


@dataclass(frozen=True)
class JournalBatch:
    """Consecutive entries."""

    owner_epoch: int
    entries: tuple[JournalEntry, ...]
    end_offset: int
    """One past the newest entry at the time of the answer: how far the follower is behind."""
    is_final: bool
    """The run is over: nothing comes after `end_offset` until it is resumed."""


@dataclass(frozen=True)
class RunStarted:
    """Journal: an owner took the run; the first entry of every journal, and of every restart."""

    run: str
    owner_epoch: int
    preset_json: str
    software_version: str


@dataclass(frozen=True)
class TicketIssued:
    """Journal: an attempt was handed to an actor."""

    ticket: Ticket
    actor: str
    incarnation: str
    nonce: str


@dataclass(frozen=True)
class AttemptEnded:
    """Journal: an attempt came to its end."""

    ticket: int
    attempt: int
    verdict: Verdict
    trajectory: TrajectoryId | None
    """None when the attempt was lost."""
    steps: int
    is_last_part: bool
    """With `accepted`: the ticket is complete."""
    reason: str
    """Why, for a person; empty when accepted."""


@dataclass(frozen=True)
class TicketReseeded:
    """Journal: the ticket's attempts failed too often; its seed was void and is replaced."""

    ticket: int
    generation: int
    """Counts the replaced seeds."""


@dataclass(frozen=True)
class SnapshotTaken:
    """Journal: a policy version exists."""

    version: int
    digest: str
    tickets_absorbed: int
    """Tickets that were in the memory when it was trained."""


@dataclass(frozen=True)
class IterationEnded:
    """Journal: an iteration's episodes are in the memory and learned from."""

    iteration: int
    digest: str
    """SHA-256 over the ids of its accepted trajectories, in ticket order."""
    mean_return: float
    success_rate: float


@dataclass(frozen=True)
class FollowerJoined:
    """Journal: a process keeps a copy of the journal; policy versions wait until it has them."""

    role: Role
    id: str
