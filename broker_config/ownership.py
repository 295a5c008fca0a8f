"""One process at a time: a lock on a file that the kernel releases when its holder dies.

`flock` also frees the lock after `kill -9`, so there is no stale lock to clean up. It holds among
processes of one host, and on network file systems only where those support it; between hosts the
owner's liveliness token and epoch tell.
"""

from __future__ import annotations

import fcntl
import os
import socket
from pathlib import Path

from broker_config.closing import Closing
from broker_config.errors import AlreadyOwned, StorageError

RUN_LOCK = "owner.lock"


class FileLock(Closing):
    """Holds a file exclusively from construction until `close`.

    The file stays after the release: deleting it would let two processes hold two files of one
    name.
    """

    def __init__(self, path: Path, subject: str) -> None:
        """Takes the lock.

        Args:
            path: The file; made with its folder if it is missing.
            subject: What the lock protects, as errors call it.

        Raises:
            AlreadyOwned: Another process holds it.
            StorageError: The file cannot be made or locked.
        """
        self._descriptor = _open(path, subject)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(self._descriptor, 256, 0).decode(errors="replace").strip()
            os.close(self._descriptor)
            raise AlreadyOwned(
                f"{subject}: expected no other owner; got {holder or 'an unnamed process'} "
                f"(lock {path}); stop that process, or use another folder"
            ) from error
        except OSError as error:
            os.close(self._descriptor)
            raise StorageError(
                f"{subject}: expected a file system with locks; got {error} for {path}; "
                "move the folder to a local disk"
            ) from error
        self._name_holder()

    def _name_holder(self) -> None:
        # For a person: the lock itself is the kernel's, whatever the file says.
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, f"pid {os.getpid()} on {socket.gethostname()}\n".encode(), 0)

    def close(self) -> None:
        """Releases the lock; a second call does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def own_run(folder: Path) -> FileLock:
    """Takes the folder of a run; hold the result for as long as the run is owned.

    Raises:
        AlreadyOwned: Another process owns the run; the text names it.
        StorageError: The folder cannot be written.
    """
    return FileLock(folder / RUN_LOCK, f"run {folder}")


def _open(path: Path, subject: str) -> int:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise StorageError(
            f"{subject}: expected a folder that can be written; got {error}; "
            "check its permissions, or choose another folder"
        ) from error
