"""What every clothbus process does first: logging, one torch thread, an end with its parent."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from types import FrameType
from typing import TypeVar

from broker_config.errors import AlreadyOwned

_log = logging.getLogger(__name__)

T = TypeVar("T")

PARENT_VARIABLE = "CLOTHBUS_PARENT_PID"
"""Set by a supervisor: the process ends when this parent does, however the parent ends."""

FAILED_CHECK_EXIT = 1
"""Exit code when what was tested does not hold."""

CONFIGURATION_EXIT = 3
"""Exit code of an error that a restart would only repeat."""

UNREACHABLE_EXIT = 4
"""Exit code when there is no router: it may come back."""

INTERRUPTED_EXIT = 130
"""Exit code after Ctrl-C, as shells have it."""

TERMINATED_EXIT = 143
"""Exit code after SIGTERM before the work was finished: 0 means finished or drained."""

HELD_SECS = 15.0
"""A process whose supervisor was killed lets go of its files in this time."""

_POLL_SECS = 0.1
_PR_SET_PDEATHSIG = 1

_asked_by = signal.SIGINT
"""The signal that asked this process to leave."""


def child_environment() -> Mapping[str, str]:
    """The environment for a child process that must not outlive this one."""
    torch = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    # Importing it would look through all installed packages for devices that we do not use.
    torch["TORCH_DEVICE_BACKEND_AUTOLOAD"] = "0"
    return {**os.environ, **torch, PARENT_VARIABLE: str(os.getpid())}


def end_with_supervisor() -> None:
    """Ends this process with the one that `child_environment` named, if there is one."""
    if (supervisor := os.environ.get(PARENT_VARIABLE)) is not None:
        end_with_parent(int(supervisor))


def end_with_parent(parent_pid: int) -> None:
    """Has the kernel terminate this process when its parent dies, however it dies (Linux)."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent_pid:  # it died before we asked
        sys.exit(f"clothbus: parent process {parent_pid} is gone")


def take_when_free(take: Callable[[], T]) -> T:
    """Takes something that only one process may have.

    Whoever has a supervisor waits for a while: the supervisor may have come right after one that
    was killed, whose processes are still on their way out.

    Raises:
        AlreadyOwned: Another process has it, and keeps it.
    """
    is_supervised = PARENT_VARIABLE in os.environ
    deadline_secs = time.monotonic() + (HELD_SECS if is_supervised else 0.0)
    while True:
        try:
            return take()
        except AlreadyOwned as error:
            if time.monotonic() >= deadline_secs:
                raise
            _log.debug("Waiting: %s", error)
            time.sleep(_POLL_SECS)


def on_terminate(handler: Callable[[], None]) -> None:
    """Calls `handler` in the main thread on SIGTERM and SIGINT, and notes which it was."""

    def handle(number: int, _: FrameType | None) -> None:
        global _asked_by  # as signals are the process's, so is this
        _asked_by = signal.Signals(number)
        handler()

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)


def interrupt() -> None:
    """Ends the main thread as Ctrl-C does; for processes whose every state is safe on disk."""
    raise KeyboardInterrupt


def unfinished_exit() -> int:
    """The exit code of a process that was asked to leave before its work was finished."""
    return TERMINATED_EXIT if _asked_by is signal.SIGTERM else INTERRUPTED_EXIT


def log_to_stderr() -> None:
    """Logs one line for each event, with its time, level and module."""
    logging.basicConfig(
        level=logging.INFO,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
        stream=sys.stderr,
    )


def use_one_torch_thread() -> None:
    """Fixes torch's thread count: results then do not depend on the machine's load or cores."""
    import torch

    torch.set_num_threads(1)
