"""Pulls a run's journal, and the policies that it names, for whoever keeps a copy."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import TypeVar

from broker_config.bus import Bus
from broker_config.codec import decode_any
from broker_config.errors import OwnerUnreachable, Refused, StorageError
from broker_config.failpoints import Failpoint, reach
from broker_config.joining import RETRY_SECS, attach
from broker_config.messages import (
    JournalBatch,
    JournalEntry,
    JournalRequest,
    Role,
    Snapshot,
    SnapshotRequest,
    SnapshotTaken,
)
from broker_config.recording.recording import Recording
from deploy.recorder.inbox import JournalPart, LostSnapshot, RecorderInbox

_log = logging.getLogger(__name__)

BATCH_BYTES = 4 << 20
POLL_SECS = 0.05
"""Between two questions when there is nothing new."""

ASK_TIMEOUT_SECS = 5.0
_ROLE: Role = "recorder"

R = TypeVar("R")


class _Stopped(Exception):
    """The follower was asked to leave."""


class JournalFollower:
    """A thread with one question under way at a time; as a context it follows.

    Attributes:
        end_offset: One past the newest entry of the journal, as far as is known.
        has_finished: The run is over, and the recording holds everything.
        is_waiting: The owner has not let us in yet, or does not answer.
        failure: Why following cannot go on, if it cannot.
    """

    def __init__(
        self, bus: Bus, name: str, incarnation: str, recording: Recording, inbox: RecorderInbox
    ) -> None:
        """Prepares it.

        Args:
            bus: The recorder's.
            name: The recorder's.
            incarnation: Of this process.
            recording: Where it goes on; it says how much is held.
            inbox: Where what is to be written goes.
        """
        self._bus = bus
        self._name = name
        self._incarnation = incarnation
        self._recording = recording
        self._inbox = inbox
        self._offset = recording.next_offset
        self._owner_epoch = -1
        self._is_over = False
        self._stop = threading.Event()
        self.end_offset = recording.next_offset
        self.has_finished = False
        self.is_waiting = True
        self.failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="journal-follower", daemon=True)

    def __enter__(self) -> JournalFollower:
        self._inbox.open_journal()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._inbox.close_journal()
        self._thread.join()

    def _run(self) -> None:
        try:
            self._attach()
            while not self.has_finished:
                self._follow_once()
        except _Stopped:
            pass
        except Exception as error:  # the writing thread raises it
            self.failure = error

    def _follow_once(self) -> None:
        held_offset = self._recording.held_offset
        try:
            batch = self._ask(held_offset)
        except OwnerUnreachable as error:
            # An owner that is over leaves as soon as it knows that we hold everything.
            self.has_finished = self._is_over and held_offset >= self.end_offset
            self._wait_for_owner(error)
            return
        self.is_waiting = False
        reach(Failpoint.BATCH_RECEIVED)
        self._check(batch)
        self._hand_over(batch)
        is_all = self._offset >= batch.end_offset
        self._is_over = batch.is_final and is_all
        self.has_finished = self._is_over and held_offset >= batch.end_offset
        if is_all and self._stop.wait(POLL_SECS):
            raise _Stopped

    def _attach(self) -> None:
        welcome = self._insist(
            lambda: attach(self._bus, _ROLE, self._name, self._incarnation, None, self._stop.wait)
        )
        self._owner_epoch = welcome.owner_epoch

    def _ask(self, held_offset: int) -> JournalBatch:
        request = JournalRequest(
            _ROLE, self._name, self._incarnation, self._offset, held_offset, BATCH_BYTES
        )
        key = self._bus.keys.journal(_ROLE, self._name)
        return self._bus.ask(key, request, JournalBatch, timeout_secs=ASK_TIMEOUT_SECS)

    def _check(self, batch: JournalBatch) -> None:
        if batch.end_offset < self._offset:
            raise StorageError(
                f"journal: expected at least the {self._offset} entries that are recorded; got "
                f"{batch.end_offset}; it is another run's or has lost its end: record into "
                "another folder"
            )
        if batch.owner_epoch != self._owner_epoch:
            self._attach()
        self.end_offset = batch.end_offset

    def _hand_over(self, batch: JournalBatch) -> None:
        """In parts, each with the weights of one policy at most."""
        items: list[JournalEntry | Snapshot | LostSnapshot] = []
        for entry in batch.entries:
            if (taken := _snapshot_of(entry)) is not None and not self._is_recorded(taken):
                self._give(items, end_of_batch=False)
                items = [self._weights(taken)]
            items.append(entry)
        if items:
            self._give(items, end_of_batch=True)
        self._offset += len(batch.entries)

    def _give(
        self, items: list[JournalEntry | Snapshot | LostSnapshot], *, end_of_batch: bool
    ) -> None:
        if items and not self._inbox.hand_over(JournalPart(items, end_of_batch)):
            raise _Stopped

    def _is_recorded(self, taken: SnapshotTaken) -> bool:
        return self._recording.has_snapshot(taken.version, taken.digest)

    def _weights(self, taken: SnapshotTaken) -> Snapshot | LostSnapshot:
        key = self._bus.keys.policy_version(taken.version)
        request = SnapshotRequest(taken.version)
        try:
            snapshot = self._insist(
                lambda: self._bus.ask(key, request, Snapshot, timeout_secs=ASK_TIMEOUT_SECS)
            )
        except Refused as error:
            _log.warning("Policy version %d cannot be recorded: %s", taken.version, error)
            return LostSnapshot(taken.version)
        if snapshot.digest != taken.digest:
            _log.warning(
                "Policy version %d cannot be recorded: expected digest %s; got %s, which took its "
                "place",
                taken.version,
                taken.digest,
                snapshot.digest,
            )
            return LostSnapshot(taken.version)
        return snapshot

    def _insist(self, ask: Callable[[], R]) -> R:
        while not self._stop.is_set():
            try:
                answer = ask()
            except OwnerUnreachable as error:
                self._wait_for_owner(error)
            else:
                self.is_waiting = False
                return answer
        raise _Stopped

    def _wait_for_owner(self, error: OwnerUnreachable) -> None:
        if not self.has_finished:
            self.is_waiting = True
            _log.debug("%s", error)
            if self._stop.wait(RETRY_SECS):
                raise _Stopped


def _snapshot_of(entry: JournalEntry) -> SnapshotTaken | None:
    if not entry.name.startswith("snapshot/"):
        return None
    message = decode_any(entry.payload)
    return message if isinstance(message, SnapshotTaken) else None
