"""What a run appends to its journal, and who is told of it.

Journal entries are named, and a name is appended at most once, so that every step may be repeated
after a crash:

====================================  ==============================================================
`run/<epoch>`                         `RunStarted`
`demonstration/<number>`              `Trajectory`, what is initialised from, or imitated
`target/<number>`                     `TargetsMarked` by a person, of that demonstration
`ticket/<index>/<attempt>`            `TicketIssued`
`trajectory/<actor>/<inc.>/<seq.>`    `Trajectory`, every attempt that arrived
`ended/<actor>/<inc.>/<seq.>`         `AttemptEnded`, in the transaction of its trajectory
`lost/<index>/<attempt>`              `AttemptEnded` without a trajectory
`reseeded/<index>/<generation>`       `TicketReseeded`
`snapshot/<version>/<digest>`         `SnapshotTaken`
`announced/<iteration>`               `IterationAnnounced`
`rewards/<iteration>`                 `Rewards`
`iteration/<number>`                  `IterationEnded`
`control/<epoch>/<number>`            `Control`
`follower/<id>/<epoch>/<number>`      `FollowerJoined`
====================================  ==============================================================
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Future

from broker_config.codec import encode
from broker_config.errors import ClothbusError, StorageError
from broker_config.journal import Appended, Journal
from broker_config.messages import AttemptEnded, TicketIssued, TicketReseeded, Verdict
from learner.tickets import TicketEvent

_log = logging.getLogger(__name__)

MOST_GENERATIONS = 20
"""A ticket whose seed was replaced this often will not be solved by one more."""

Committed = Future[tuple[Appended, ...]]
"""Resolves once entries are durable."""


class RunJournal:
    """Appends entries by their names; what cannot be written ends the run.

    Thread-safe.

    Attributes:
        changed: Notified whenever a waiting ticket request or the learning loop may go on.
        changes: How often that was.
        attempts: Of this epoch, those that went wrong.
    """

    def __init__(self, journal: Journal) -> None:
        self.changed = threading.Condition()
        self.changes = 0
        self.attempts: Counter[Verdict] = Counter()
        self._journal = journal
        self._failure: ClothbusError | None = None

    @property
    def has_failed(self) -> bool:
        """Whether the run cannot go on."""
        return self._failure is not None

    def require_sound(self) -> None:
        """Raises what has ended the run, if anything has."""
        if self._failure is not None:
            raise self._failure

    def note_change(self) -> None:
        """Wakes whoever waits for something to happen."""
        with self.changed:
            self.changes += 1
            self.changed.notify_all()

    def fail(self, error: BaseException) -> None:
        """Ends the run with an error, from any thread: nothing more is issued or acked."""
        _log.error("The run cannot go on: %s", error)
        with self.changed:
            self._failure = error if isinstance(error, ClothbusError) else StorageError(str(error))
            self.note_change()

    def append(self, *entries: tuple[str, object]) -> Committed:
        """Appends messages, or payloads that are encoded already, in one transaction."""
        if not entries:
            return nothing_to_commit()
        future = self._journal.append(
            [(name, item if isinstance(item, bytes) else encode(item)) for name, item in entries]
        )
        future.add_done_callback(self._note_append_failure)
        return future

    def append_events(self, events: Sequence[TicketEvent], *first: tuple[str, object]) -> Committed:
        """Appends what has become of tickets, after other entries of the same transaction."""
        for event in events:
            self._note_trouble(event)
        return self.append(*first, *map(_named, events))

    def _note_append_failure(self, done: Committed) -> None:
        if (error := done.exception()) is not None:
            self.fail(error)

    def _note_trouble(self, event: TicketEvent) -> None:
        """Says what went wrong; a ticket that no seed solves ends the run."""
        if isinstance(event, AttemptEnded) and event.reason:
            self.attempts[event.verdict] += 1
            _log.warning("Ticket %d: %s, %s", event.ticket, event.verdict.value, event.reason)
        if isinstance(event, TicketReseeded) and event.generation >= MOST_GENERATIONS:
            self.fail(
                StorageError(
                    f"ticket {event.ticket}: expected a sound attempt with one of "
                    f"{MOST_GENERATIONS} seeds; got none; see the learner's log for the reasons, "
                    "and mend the task or the simulator"
                )
            )


def nothing_to_commit() -> Committed:
    """A future that has resolved."""
    future: Committed = Future()
    future.set_result(())
    return future


def _named(event: TicketEvent) -> tuple[str, TicketEvent]:
    match event:
        case TicketIssued(ticket=ticket):
            return f"ticket/{ticket.index}/{ticket.attempt}", event
        case AttemptEnded(trajectory=None):
            return f"lost/{event.ticket}/{event.attempt}", event
        case AttemptEnded():
            return f"ended/{event.trajectory}", event
        case TicketReseeded():
            return f"reseeded/{event.ticket}/{event.generation}", event
