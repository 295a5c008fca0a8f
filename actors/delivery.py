"""Sends what is spooled until the owner has it: a window of queries, each resent until acked."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

from broker_config.bus import Bus
from broker_config.errors import BusError, OwnerUnreachable
from broker_config.failpoints import Failpoint, reach
from broker_config.messages import Ack, TrajectoryId
from broker_config.queries import PendingReply
from broker_config.spool import Spool

_log = logging.getLogger(__name__)

WINDOW = 4
"""Unanswered trajectories at a time: enough to hide the round trip, few enough to bound memory."""

ACK_TIMEOUT_SECS = 5.0
RETRY_SECS = 0.5


class Delivery:
    """A thread that empties the spool into the owner's journal, oldest first."""

    def __init__(self, bus: Bus, spool: Spool, key: str, owner_epoch: Callable[[], int]) -> None:
        """Prepares it; as a context it delivers.

        Args:
            bus: The actor's.
            spool: What it empties.
            key: Where the owner takes trajectories.
            owner_epoch: Says which owner the actor has joined; the ack of an earlier one, which is
                perhaps cut off from the run, is not believed.
        """
        self._bus = bus
        self._owner_epoch = owner_epoch
        self._spool = spool
        self._key = key
        self._changed = threading.Condition()
        self._generation = 0
        self._closing = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="delivery", daemon=True)

    def __enter__(self) -> Delivery:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._closing = True
            self._generation += 1
            self._changed.notify_all()
        self._thread.join()

    def notify(self) -> None:
        """Says that the spool has something new.

        Raises:
            ClothbusError: Delivery has failed for good: the owner refuses, or the spool is broken.
        """
        with self._changed:
            self._generation += 1
            self._changed.notify_all()
            if self._failure is not None:
                raise self._failure

    def flush(self, keep_waiting: Callable[[], bool]) -> bool:
        """Waits until everything is acked; returns whether it is.

        Args:
            keep_waiting: Asked several times a second; False gives up. Nothing is lost by that:
                what is left is delivered at the next start.

        Raises:
            ClothbusError: Delivery has failed for good.
        """
        self.notify()
        with self._changed:
            while self._spool.status().trajectories and keep_waiting() and self._failure is None:
                self._changed.wait(0.1)
            if self._failure is not None:
                raise self._failure
            return not self._spool.status().trajectories

    def _run(self) -> None:
        try:
            while not self._closing:
                seen = self._generation
                delivered = self._deliver_all()
                with self._changed:
                    self._changed.notify_all()
                    if delivered:
                        self._changed.wait_for(lambda seen=seen: self._generation != seen)  # type: ignore[misc]
                    else:
                        self._changed.wait_for(lambda: self._closing, RETRY_SECS)
        except Exception as error:  # the actor's thread raises it: nothing may be lost in silence
            _log.exception("Delivery stopped")
            with self._changed:
                self._failure = error
                self._changed.notify_all()

    def _deliver_all(self) -> bool:
        """One pass over the spool; returns whether all of it was acked."""
        window: deque[tuple[TrajectoryId, PendingReply[Ack]]] = deque()
        complete = True
        for spooled in self._spool.pending():
            reply = self._bus.ask_later(
                self._key, spooled.payload, Ack, timeout_secs=ACK_TIMEOUT_SECS
            )
            reach(Failpoint.TRAJECTORY_SENT)
            window.append((spooled.id, reply))
            if len(window) == WINDOW:
                complete &= self._settle(*window.popleft())
            if self._closing or not complete:
                break
        while window:
            complete &= self._settle(*window.popleft())
        return complete

    def _settle(self, id_: TrajectoryId, pending: PendingReply[Ack]) -> bool:
        try:
            ack = pending.result()
        except OwnerUnreachable:
            return False
        except BusError as error:
            _log.error("Trajectory %s refused: %s", id_, error)
            raise
        if ack.id != id_ or ack.owner_epoch < self._owner_epoch():
            _log.warning("Not believed: %s, for trajectory %s", ack, id_)
            return False
        reach(Failpoint.ACK_RECEIVED)
        self._spool.acknowledge(id_)
        return True


def wait_until(deadline_secs: float) -> Callable[[], bool]:
    """A `keep_waiting` that gives up at a time of the monotonic clock."""
    return lambda: time.monotonic() < deadline_secs
