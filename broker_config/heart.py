"""A process's sign of life: a liveliness token that dies with it, and heartbeats while it moves."""

from __future__ import annotations

import logging
import os
import socket
import threading
from collections.abc import Callable, Mapping

from broker_config.bus import Bus
from broker_config.errors import ClothbusError
from broker_config.messages import Heartbeat, Role

_log = logging.getLogger(__name__)

HEARTBEAT_SECS = 0.5

Vitals = Callable[[], tuple[str, Mapping[str, float]]]
"""Says the state in a word, and the numbers that `clothbus status` shows."""


class Heart:
    """Beats on a thread of its own for as long as the context lasts.

    It shows that the process runs, not that its main thread gets anywhere.
    """

    def __init__(
        self, bus: Bus, role: Role, process_id: str, incarnation: str, vitals: Vitals
    ) -> None:
        self._bus = bus
        self._role: Role = role
        self._id = process_id
        self._incarnation = incarnation
        self._vitals = vitals
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
                    self._role, self._id, self._incarnation, host, pid, state, dict(numbers)
                )
                self._publisher.put(beat)
            except ClothbusError as error:
                _log.debug("Heartbeat not sent: %s", error)
            if self._stop.wait(HEARTBEAT_SECS):
                return
