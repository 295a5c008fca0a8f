"""A process's sign of life: a liveliness token that dies with it, and heartbeats while it moves."""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping

from broker_config.bus import Bus
from broker_config.errors import ClothbusError
from broker_config.messages import Heartbeat, Role

_log = logging.getLogger(__name__)

HEARTBEAT_SECS = 0.5

Vitals = Callable[[], tuple[str, Mapping[str, float]]]
"""Says the state in a word, and the numbers that `clothbus status` shows."""


HUNG_SECS = 60.0
"""A process whose main thread gets nowhere for so long hangs; a step of a robot takes seven."""


class Pulse:
    """Shows that the main thread gets somewhere: it beats, the heart's thread looks."""

    def __init__(self) -> None:
        self._beat_secs = time.monotonic()

    def beat(self) -> None:
        """Called by the main thread wherever it gets on, and while it waits for others."""
        self._beat_secs = time.monotonic()

    @property
    def stalled_secs(self) -> float:
        """How long ago that was."""
        return time.monotonic() - self._beat_secs


class Heart:
    """Beats on a thread of its own for as long as the context lasts.

    A heartbeat shows that the process runs; the pulse in it, that its main thread gets on.
    """

    def __init__(
        self,
        bus: Bus,
        role: Role,
        process_id: str,
        incarnation: str,
        vitals: Vitals,
        pulse: Pulse,
    ) -> None:
        self._bus = bus
        self._role: Role = role
        self._id = process_id
        self._incarnation = incarnation
        self._vitals = vitals
        self._pulse = pulse
        self._stop = threading.Event()
        self._publisher = bus.publisher(bus.keys.live(role, process_id))
        self._thread = threading.Thread(target=self._run, name="heart", daemon=True)

    def __enter__(self) -> Heart:
        self._bus.declare_alive()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        host, pid = socket.gethostname(), os.getpid()
        while True:
            try:
                state, numbers = self._vitals()
                beat = Heartbeat(
                    self._role,
                    self._id,
                    self._incarnation,
                    host,
                    pid,
                    state,
                    self._pulse.stalled_secs,
                    {**numbers, "rejected": self._bus.rejected.total},
                )
                self._publisher.put(beat)
            except ClothbusError as error:
                _log.debug("Heartbeat not sent: %s", error)
            if self._stop.wait(HEARTBEAT_SECS):
                return
