"""Imports PyBullet without the line that it prints, which would break a progress display.

from actors.cloth.quiet_pybullet import pybullet
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def _silenced() -> Iterator[None]:
    # The line comes from C, so that only the file descriptors themselves can hold it back.
    sys.stdout.flush()
    sys.stderr.flush()
    kept = {fd: os.dup(fd) for fd in (1, 2)}
    with Path(os.devnull).open("wb") as nowhere:
        for fd in kept:
            os.dup2(nowhere.fileno(), fd)
        try:
            yield
        finally:
            for fd, original in kept.items():
                os.dup2(original, fd)
                os.close(original)


with _silenced():
    import pybullet

__all__ = ["pybullet"]
