"""Long polls: holds ticket requests until there is something to collect."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from broker_config.errors import StorageError
from broker_config.messages import TicketReply, TicketRequest
from learner.owner import Owner

_log = logging.getLogger(__name__)

POLL_SECS = 2.0
"""A request is answered with `wait` after this long; shorter than the asker's timeout."""

LEASE_CHECK_SECS = 0.5


@dataclass(frozen=True)
class _Held:
    request: TicketRequest
    answer: Callable[[TicketReply], None]
    deadline_secs: float


class TicketDesk:
    """Answers ticket requests in the order of their arrival, on a thread of its own."""

    def __init__(self, owner: Owner) -> None:
        self._owner = owner
        self._held: list[_Held] = []
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
        with self._owner.changed:
            # An actor has one question at a time: a newer one replaces what it no longer awaits.
            given_up = [other for other in self._held if other.request.actor == request.actor]
            self._held = [other for other in self._held if other not in given_up] + [held]
            self._owner.note_change()
        for other in given_up:
            other.answer(self._owner.wait_reply(other.request))

    def _run(self) -> None:
        while not self._closing:
            seen = self._owner.changes
            self._owner.expire_leases(time.monotonic())
            with self._owner.changed:
                round_ = list(self._held)
            answered = [held for held in round_ if self._try_answer(held)]
            with self._owner.changed:
                self._held = [held for held in self._held if held not in answered]
                self._owner.changed.wait_for(
                    lambda seen=seen: self._owner.changes != seen,  # type: ignore[misc]
                    LEASE_CHECK_SECS,
                )
        for held in self._held:
            held.answer(self._owner.wait_reply(held.request))

    def _try_answer(self, held: _Held) -> bool:
        now_secs = time.monotonic()
        issued = self._owner.issue(held.request, now_secs)
        if issued is not None:
            reply, committed = issued
            try:
                committed.result()
            except StorageError as error:
                _log.error("Ticket for %s not issued: %s", held.request.actor, error)
                return True  # unanswered: the actor asks the next owner again
            held.answer(reply)
            return True
        if now_secs >= held.deadline_secs:
            held.answer(self._owner.wait_reply(held.request))
            return True
        return False
