"""Long polls: holds ticket requests until there is something to collect."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

from broker_config.failpoints import Failpoint, reach
from broker_config.journal import Appended
from broker_config.messages import TicketReply, TicketRequest
from learner.owner import Owner

_log = logging.getLogger(__name__)

POLL_SECS = 2.0
"""A request is answered with `wait` after this long; shorter than the asker's timeout."""

LEASE_CHECK_SECS = 0.5


@dataclass
class _Held:
    request: TicketRequest
    answer: Callable[[TicketReply], None]
    deadline_secs: float
    was_decided: bool = False
    """The owner has seen it, and had nothing."""


class TicketDesk:
    """Answers ticket requests in the order of their arrival, on a thread of its own.

    A request is either held or being decided, never both, so that it is answered exactly once.
    """

    def __init__(self, owner: Owner) -> None:
        self._owner = owner
        self._held: dict[str, _Held] = {}
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="ticket-desk", daemon=True)

    def __enter__(self) -> TicketDesk:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing = True
        self._owner.note_change()
        self._thread.join()

    def ask(self, request: TicketRequest, answer: Callable[[TicketReply], None]) -> None:
        """Holds a request; `answer` is called once, from the desk's thread or this one."""
        held = _Held(request, answer, time.monotonic() + POLL_SECS)
        self._hold(held, replaces=True)
        self._owner.note_change()

    def _hold(self, held: _Held, replaces: bool) -> None:
        """An actor has one question at a time: the newer one stays, the other is told to wait."""
        actor = held.request.actor
        with self._owner.changed:
            other = self._held.get(actor)
            if other is None or replaces:
                self._held[actor] = held
            else:
                other = held
        if other is not None:
            other.answer(self._owner.wait_reply(other.request))

    def _run(self) -> None:
        try:
            leases_checked_secs = -math.inf
            while not self._closing:
                seen = self._owner.changes
                if (now_secs := time.monotonic()) >= leases_checked_secs + LEASE_CHECK_SECS:
                    self._owner.expire_leases(now_secs)
                    leases_checked_secs = now_secs
                self._decide_all()
                with self._owner.changed:
                    self._owner.changed.wait_for(
                        lambda seen=seen: self._owner.changes != seen,  # type: ignore[misc]
                        LEASE_CHECK_SECS,
                    )
        except Exception as error:
            _log.exception("The ticket desk stopped")
            self._owner.fail(error)
        while self._held:
            _, held = self._held.popitem()
            held.answer(self._owner.wait_reply(held.request))

    def _decide_all(self) -> None:
        for actor in list(self._held):
            with self._owner.changed:
                held = self._held.pop(actor, None)
            if held is not None and not self._try_answer(held):
                self._hold(held, replaces=False)

    def _try_answer(self, held: _Held) -> bool:
        now_secs = time.monotonic()
        # With many actors waiting, asking for each of them after each change would take all time.
        if not held.was_decided or self._owner.has_news_for(held.request.actor):
            issued = self._owner.issue(held.request, now_secs)
            if issued is not None:
                _answer_once_committed(held, *issued)
                return True
            held.was_decided = True
        if now_secs >= held.deadline_secs:
            held.answer(self._owner.wait_reply(held.request))
            return True
        return False


def _answer_once_committed(
    held: _Held, reply: TicketReply, committed: Future[tuple[Appended, ...]]
) -> None:
    """Others need not wait for this commit; if it fails, the owner ends the run with the reason."""

    def answer(done: Future[tuple[Appended, ...]]) -> None:
        if done.exception() is None:
            reach(Failpoint.TICKET_JOURNALED)
            held.answer(reply)

    committed.add_done_callback(answer)
