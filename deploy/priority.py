"""Work that gives way: it has only the processor time that nobody else wants."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import Literal

Priority = Literal["idle", "normal"]
"""What is left over, or a share like everybody's."""

_log = logging.getLogger(__name__)

_LEAST_NICE = 19
_AUTOGROUP = Path("/proc/self/autogroup")


def give_way() -> None:
    """Gives the calling thread, and the processes that it starts, the lowest priority there is.

    On Linux other threads of the process keep theirs, so that heartbeats and messages are not held
    up. Elsewhere the whole process gives way.
    """
    if sys.platform != "linux":
        os.nice(_LEAST_NICE)
        return
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    # Where the kernel groups by session, a thread's priority counts among its own session only;
    # the group has one too. A session that others share is theirs as well: it stays as it is.
    if os.getsid(0) == os.getpid() and _AUTOGROUP.exists():
        try:
            _AUTOGROUP.write_text(str(_LEAST_NICE))
        except OSError as error:
            _log.warning("The session keeps its priority among others: %s", error)
