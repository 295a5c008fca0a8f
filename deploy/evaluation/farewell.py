"""The end of a run: the evaluator scores the last policy after the learner has finished."""

from __future__ import annotations

import threading
import time

from broker_config.bus import Bus
from broker_config.keys import ParsedKey
from broker_config.messages import Heartbeat
from deploy.evaluation.scores import WAITING_FOR_OWNER
from deploy.running.launch import Supervisor
from deploy.running.progress import Progress

HOPELESS_SECS = 5.0
"""An evaluator that still waits for the learner after this time waits in vain."""

POLL_SECS = 0.1


class EvaluatorFarewell:
    """Waits for a run's evaluator to finish, for as long as there is something to wait for."""

    def __init__(self, bus: Bus, evaluator: str) -> None:
        """Listens to the evaluator from now on."""
        self._evaluator = evaluator
        self._state = "starting"
        self._waits_since_secs: float | None = None
        self._lock = threading.Lock()
        bus.subscribe(bus.keys.live("evaluator", evaluator), Heartbeat, self._on_heartbeat)

    def _on_heartbeat(self, _: ParsedKey, heartbeat: Heartbeat) -> None:
        with self._lock:
            self._state = heartbeat.state
            if heartbeat.state != WAITING_FOR_OWNER:
                self._waits_since_secs = None
            elif self._waits_since_secs is None:
                self._waits_since_secs = time.monotonic()

    def wait(self, supervisor: Supervisor, progress: Progress) -> bool:
        """Keeps the evaluator alive until it has finished; call it when the learner has.

        Returns:
            Whether it has finished; False if it still needs the learner, which a run that was
            stopped before its end does not have any more.

        Raises:
            ProcessFailed: A process cannot be kept alive.
        """
        began_secs = time.monotonic()
        while not supervisor.has_finished(self._evaluator):
            supervisor.check()
            with self._lock:
                state, since_secs = self._state, self._waits_since_secs
            if since_secs is not None:
                since_secs = max(since_secs, began_secs)
                if time.monotonic() - since_secs > HOPELESS_SECS:
                    return False
            progress.wait_for(self._evaluator, state, supervisor.processes)
            time.sleep(POLL_SECS)
        return True
