"""The end of a run: the recorder finishes its file after the learner has finished."""

from __future__ import annotations

import logging
import threading
import time

from broker_config.bus import Bus
from broker_config.keys import ParsedKey
from broker_config.messages import Heartbeat
from deploy.running.launch import Supervisor

_log = logging.getLogger(__name__)

MOST_SECS = 60.0
STANDSTILL_SECS = 10.0
"""A recorder that gets nowhere for so long waits for a learner that is gone."""

POLL_SECS = 0.1


class RecorderFarewell:
    """Waits for a run's recorder to finish, for as long as it gets anywhere."""

    def __init__(self, bus: Bus, recorder: str) -> None:
        """Listens to the recorder from now on."""
        self._recorder = recorder
        self._last: tuple[str, str, float] | None = None
        self._changed_secs = 0.0
        self._lock = threading.Lock()
        bus.subscribe(bus.keys.live("recorder", recorder), Heartbeat, self._on_heartbeat)

    def _on_heartbeat(self, _: ParsedKey, heartbeat: Heartbeat) -> None:
        next_offset = heartbeat.numbers.get("next_offset", 0.0)
        now = heartbeat.incarnation, heartbeat.state, next_offset
        with self._lock:
            if now != self._last:
                self._last, self._changed_secs = now, time.monotonic()

    def wait(self, supervisor: Supervisor) -> bool:
        """Keeps the recorder alive until it has finished; call it when the learner has.

        Returns:
            Whether it has finished; False if it lacks something of the journal, which the recorder
            of the resumed run will ask for.

        Raises:
            ProcessFailed: A process cannot be kept alive.
        """
        began_secs = time.monotonic()
        while not supervisor.has_finished(self._recorder):
            supervisor.check()
            with self._lock:
                changed_secs = max(self._changed_secs, began_secs)
            now_secs = time.monotonic()
            if now_secs - changed_secs > STANDSTILL_SECS or now_secs - began_secs > MOST_SECS:
                _log.warning("The recording may lack the end of the run; --resume completes it")
                return False
            time.sleep(POLL_SECS)
        return True
