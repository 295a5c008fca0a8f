"""Who hangs: judges the processes of a run by their heartbeats, and by what else is heard."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from broker_config.heart import HUNG_SECS
from broker_config.keys import ParsedKey
from broker_config.messages import Heartbeat, Role

_log = logging.getLogger(__name__)

START_SECS = 60.0
"""A process has this long until its first heartbeat: it imports, compiles and reads first."""

RECENT_SECS = 5.0
"""Ten heartbeats: whoever was heard of so lately shows that the router and we work."""


@dataclass(frozen=True)
class Living:
    """A process that runs, as its supervisor knows it."""

    role: Role
    id: str
    pid: int
    started_secs: float
    """Monotonic."""


@dataclass(frozen=True)
class Hang:
    """A process that lives and gets nowhere."""

    process: Living
    reason: str


@dataclass(frozen=True)
class _Sign:
    heard_secs: float
    progress_secs: float
    """When its main thread last got on."""


class VitalSigns:
    """Collects heartbeats, and tells who hangs.

    Silence is blamed on a process only while another one is heard. If nobody is, the router hangs;
    if a new router does not help either, they all do. Whoever judges may have been stopped itself:
    after that, everybody gets a fresh chance.

    Heartbeats may come on any thread; one thread judges.
    """

    def __init__(
        self, hung_secs: float = HUNG_SECS, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._hung_secs = hung_secs
        self._clock = clock
        self._signs: dict[tuple[Role, str, int], _Sign] = {}
        self._lock = threading.Lock()
        self._chance_secs = self._judged_secs = clock()
        self._router_blamed_secs: float | None = None

    def on_heartbeat(self, _: ParsedKey, heartbeat: Heartbeat) -> None:
        """Takes a heartbeat from the bus."""
        now_secs = self._clock()
        with self._lock:
            name = heartbeat.role, heartbeat.id, heartbeat.pid
            self._signs[name] = _Sign(now_secs, now_secs - heartbeat.stalled_secs)

    def was_heard(self, process: Living) -> bool:
        """Whether a process has ever sent a heartbeat."""
        return process.pid in self._signs_of([process])

    def has_heard(self, since_secs: float = 0.0) -> bool:
        """Whether anybody has, since a moment of the monotonic clock."""
        with self._lock:
            return any(sign.heard_secs >= since_secs for sign in self._signs.values())

    def judge(self, living: Sequence[Living]) -> list[Hang]:
        """Tells which of these processes hang; call it several times a second."""
        now_secs = self._clock()
        stood_still_secs = now_secs - self._judged_secs
        self._judged_secs = now_secs
        if stood_still_secs > self._hung_secs / 4:
            _log.warning("Looked away for %.0f s: everybody gets a fresh chance", stood_still_secs)
            self._chance_secs = now_secs
        signs = self._signs_of(living)
        speakers = _who_should_be_heard(living, signs, now_secs)
        stalled = self._stalled(speakers, signs)
        return stalled or self._silent(living, speakers, signs, now_secs)

    def _signs_of(self, processes: Sequence[Living]) -> dict[int, _Sign]:
        """By process id; what was heard before its start is of another process of that id."""
        with self._lock:
            found = {it.pid: self._signs.get((it.role, it.id, it.pid)) for it in processes}
        started_secs = {it.pid: it.started_secs for it in processes}
        return {
            pid: sign
            for pid, sign in found.items()
            if sign is not None and sign.heard_secs >= started_secs[pid]
        }

    def _stalled(self, speakers: Sequence[Living], signs: dict[int, _Sign]) -> list[Hang]:
        hangs = []
        for process in speakers:
            if (sign := signs.get(process.pid)) is not None:
                # As of its last heartbeat: since then it may have gone on.
                standstill_secs = sign.heard_secs - max(sign.progress_secs, self._chance_secs)
                if standstill_secs > self._hung_secs:
                    reason = f"its main thread has been at a standstill for {standstill_secs:.0f} s"
                    hangs.append(Hang(process, reason))
        return hangs

    def _silent(
        self,
        living: Sequence[Living],
        speakers: Sequence[Living],
        signs: dict[int, _Sign],
        now_secs: float,
    ) -> list[Hang]:
        router = next((it for it in living if it.role == "router"), None)
        fresh_secs = max(self._chance_secs, router.started_secs if router else 0.0)
        silent = []
        for process in speakers:
            sign = signs.get(process.pid)
            patience_secs = self._hung_secs if sign else max(self._hung_secs, START_SECS)
            since_secs = max(fresh_secs, sign.heard_secs if sign else process.started_secs)
            if now_secs - since_secs > patience_secs:
                reason = f"it lives and has said nothing for {now_secs - since_secs:.0f} s"
                silent.append(Hang(process, reason))
        if _are_heard(speakers, signs, now_secs):
            return silent
        is_everybody = bool(silent) and len(silent) == len(speakers)
        return self._blame_for_all(router, silent, signs, now_secs) if is_everybody else []

    def _blame_for_all(
        self,
        router: Living | None,
        silent: list[Hang],
        signs: dict[int, _Sign],
        now_secs: float,
    ) -> list[Hang]:
        if router is None:  # it is not ours: we cannot tell who hangs, nor mend it
            return []
        blamed_secs, self._router_blamed_secs = self._router_blamed_secs, None
        last_heard_secs = max((sign.heard_secs for sign in signs.values()), default=0.0)
        if blamed_secs is not None and last_heard_secs < blamed_secs:
            return silent
        self._router_blamed_secs = now_secs
        return [Hang(router, "nobody is heard through it, although all live")]


def _who_should_be_heard(
    living: Sequence[Living], signs: dict[int, _Sign], now_secs: float
) -> list[Living]:
    """All but the router, and but those whom no owner has welcomed yet: they have no voice."""
    owners = [it for it in living if it.role == "owner"]
    has_owner = _are_heard(owners, signs, now_secs)
    return [
        it
        for it in living
        if it.role != "router" and (it.role == "owner" or has_owner or it.pid in signs)
    ]


def _are_heard(processes: Sequence[Living], signs: dict[int, _Sign], now_secs: float) -> bool:
    return any(
        now_secs - signs[it.pid].heard_secs < RECENT_SECS for it in processes if it.pid in signs
    )
