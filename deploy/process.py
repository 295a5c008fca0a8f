"""What every clothbus process does first: logging, one torch thread, an end with its parent."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
from collections.abc import Callable, Mapping
from types import FrameType

PARENT_VARIABLE = "CLOTHBUS_PARENT_PID"
"""Set by a supervisor: the process ends when this parent does, however the parent ends."""

CONFIGURATION_EXIT = 3
"""Exit code of an error that a restart would only repeat."""

UNREACHABLE_EXIT = 4
"""Exit code when there is no router: it may come back."""

INTERRUPTED_EXIT = 130
"""Exit code after Ctrl-C, as shells have it."""

_PR_SET_PDEATHSIG = 1


def child_environment() -> Mapping[str, str]:
    """The environment for a child process that must not outlive this one."""
    single = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return {**os.environ, **single, PARENT_VARIABLE: str(os.getpid())}


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


def on_terminate(handler: Callable[[], None]) -> None:
    """Calls `handler` in the main thread on SIGTERM and SIGINT."""

    def handle(_: int, __: FrameType | None) -> None:
        handler()

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)


def interrupt() -> None:
    """Ends the main thread as Ctrl-C does; for processes whose every state is safe on disk."""
    raise KeyboardInterrupt


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
