"""Starts a run's processes on this machine, restarts what dies or hangs, and leaves none behind."""

from __future__ import annotations

import logging
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from broker_config.errors import ClothbusError
from deploy.process import (
    CONFIGURATION_EXIT,
    TERMINATED_EXIT,
    UNREACHABLE_EXIT,
    child_environment,
)
from deploy.running.topology import ProcessSpec
from deploy.running.vital_signs import Living, VitalSigns

_log = logging.getLogger(__name__)

SHORT_LIFE_SECS = 5.0
SHORT_LIVES_BEFORE_GIVING_UP = 5

PAUSES_SECS = (0.0, 0.5, 1.0, 2.0)
"""Before the restart after the first short life, the second, the third, and all others."""

STOP_SECS = 15.0
"""A process that was asked to end has this long; then it is killed, which loses nothing."""


class ProcessFailed(ClothbusError):
    """A process of the run cannot be kept alive."""


@dataclass
class Supervised:
    """A process and its history."""

    spec: ProcessSpec
    log_path: Path
    restarts: int = 0
    short_lives: int = 0
    """In a row."""
    fruitless_lives: int = 0
    """Short lives in a row that ended by themselves, or before the process had said anything."""
    finished: bool = False
    released: bool = False
    """It may end as it likes: nobody needs it any more."""
    started_secs: float = 0.0
    restart_at_secs: float | None = None
    """While it is dead and waits for its restart."""
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    @property
    def pid(self) -> int | None:
        """Of the living process."""
        return self.process.pid if self.process else None

    def as_living(self) -> Living:
        """As who it is judged by its heartbeats."""
        return Living(self.spec.role, self.spec.id, self.pid or 0, self.started_secs)


class Supervisor:
    """Keeps a set of processes alive until they finish by themselves or are stopped.

    A process has finished when it exits with code 0. Any other end is an accident: it is started
    again, unless its exit code says that a restart would not help, or it keeps failing at once. A
    process that hangs is killed and started again.
    """

    def __init__(self, log_folder: Path, signs: VitalSigns | None = None) -> None:
        """Prepares a supervisor.

        Args:
            log_folder: For the output of the processes.
            signs: Is told of heartbeats by the caller, and tells who hangs.
        """
        self._log_folder = log_folder
        self._signs = signs or VitalSigns()
        self._processes: dict[str, Supervised] = {}

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, spec: ProcessSpec) -> Supervised:
        """Starts a process; its output goes to `<log folder>/<id>.log`."""
        supervised = Supervised(spec, self._log_folder / f"{spec.id}.log")
        self._processes[spec.id] = supervised
        self._spawn(supervised)
        return supervised

    @property
    def processes(self) -> Sequence[Supervised]:
        """All of them, in the order in which they were started."""
        return list(self._processes.values())

    def check(self) -> None:
        """Restarts what died or hangs; call it several times a second.

        Raises:
            ProcessFailed: A process cannot be kept alive; its log's last lines say why.
        """
        self._kill_hung()
        for supervised in self._processes.values():
            if supervised.finished or supervised.process is None:
                continue
            code = supervised.process.poll()
            if code == 0 or (supervised.released and code is not None):
                supervised.finished = True
            elif supervised.restart_at_secs is not None:
                self._restart_when_due(supervised)
            elif code is not None:
                self._take_death(supervised, code)

    def has_finished(self, process_id: str) -> bool:
        """Whether a process has ended by itself, with success."""
        return self._processes[process_id].finished

    def release(self, ids: Sequence[str]) -> None:
        """Has processes end as they like: they are not started again."""
        for process_id in ids:
            self._processes[process_id].released = True

    def wait_ended(self, ids: Sequence[str], timeout_secs: float) -> bool:
        """Waits for released processes to end; returns whether all did."""
        deadline_secs = time.monotonic() + timeout_secs
        processes = [self._processes[process_id].process for process_id in ids]
        while time.monotonic() < deadline_secs:
            if all(process is None or process.poll() is not None for process in processes):
                return True
            time.sleep(0.05)
        return False

    def stop(self) -> None:
        """Ends what still lives: actors and their like, then the learner, then the router.

        A second Ctrl-C does not cut this short: what is left would outlive us.
        """
        with _signals_ignored():
            self._stop_in_order()

    def _stop_in_order(self) -> None:
        by_role: list[list[Supervised]] = [[], [], []]
        for supervised in self._processes.values():
            rank = {"actor": 0, "discriminator": 0, "evaluator": 0, "owner": 1}.get(
                supervised.spec.role, 2
            )
            by_role[rank].append(supervised)
        for group in by_role:
            self._terminate(group)

    def _terminate(self, group: Sequence[Supervised]) -> None:
        living = [item.process for item in group if item.process and item.process.poll() is None]
        for process in living:
            process.send_signal(signal.SIGTERM)
            process.send_signal(signal.SIGCONT)  # a stopped process could not obey
        deadline_secs = time.monotonic() + STOP_SECS
        for process in living:
            try:
                process.wait(max(0.0, deadline_secs - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _kill_hung(self) -> None:
        living = [
            item
            for item in self._processes.values()
            if item.process and item.process.poll() is None and not item.released
        ]
        for hang in self._signs.judge([item.as_living() for item in living]):
            _log.warning("%s hangs: %s; killing it", hang.process.id, hang.reason)
            if process := self._processes[hang.process.id].process:
                process.kill()
                process.wait()

    def _take_death(self, supervised: Supervised, code: int) -> None:
        now_secs = time.monotonic()
        is_short = now_secs - supervised.started_secs < SHORT_LIFE_SECS
        supervised.short_lives = supervised.short_lives + 1 if is_short else 0
        is_fruitless = is_short and self._is_its_own_fault(supervised, code)
        supervised.fruitless_lives = supervised.fruitless_lives + 1 if is_fruitless else 0
        gives_up = supervised.fruitless_lives >= SHORT_LIVES_BEFORE_GIVING_UP
        if code == CONFIGURATION_EXIT or gives_up:
            raise ProcessFailed(
                f"{supervised.spec.id} ended with code {code}: {_last_line(supervised.log_path)} "
                f"(more in {supervised.log_path})"
            )
        _log.warning("%s ended with code %d; starting it again", supervised.spec.id, code)
        pause_secs = PAUSES_SECS[max(0, min(supervised.short_lives, len(PAUSES_SECS)) - 1)]
        supervised.restart_at_secs = now_secs + pause_secs
        self._restart_when_due(supervised)

    def _is_its_own_fault(self, supervised: Supervised, code: int) -> bool:
        """Whether a short life counts as a sign that it cannot be kept alive."""
        if code == UNREACHABLE_EXIT:  # the router may be on its way back, if it was ever there
            return not self._signs.has_heard()
        was_ended = code in (-signal.SIGKILL, -signal.SIGTERM, TERMINATED_EXIT)
        return not (was_ended and self._has_worked(supervised))

    def _has_worked(self, supervised: Supervised) -> bool:
        """Whether a process got anywhere before it ended. A router is heard by what it carries."""
        if supervised.spec.role == "router":
            return self._signs.has_heard(supervised.started_secs)
        return self._signs.was_heard(supervised.as_living())

    def _restart_when_due(self, supervised: Supervised) -> None:
        if supervised.restart_at_secs is None or time.monotonic() < supervised.restart_at_secs:
            return
        supervised.restart_at_secs = None
        supervised.restarts += 1
        self._spawn(supervised)

    def _spawn(self, supervised: Supervised) -> None:
        supervised.started_secs = time.monotonic()
        with _open_log(supervised.log_path) as log:
            # A session of its own: Ctrl-C reaches the supervisor only, which then ends the others.
            supervised.process = subprocess.Popen(  # noqa: S603 - our own command
                supervised.spec.command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=dict(child_environment()),
                start_new_session=True,
            )


@contextmanager
def _signals_ignored() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = [signal.signal(number, signal.SIG_IGN) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, handlers, strict=True):
            signal.signal(number, handler)


def _open_log(path: Path) -> IO[bytes]:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path.open("ab")


def _last_line(path: Path) -> str:
    lines = path.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "it wrote nothing"
