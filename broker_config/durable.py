"""Files and folders that are whole or not there, also after a power cut."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from broker_config.errors import StorageError
from broker_config.failpoints import Failpoint, reach

PARTIAL_SUFFIX = ".partial"


def write_durably(path: Path, data: bytes) -> None:
    """Writes a file under another name, syncs it, renames it, and syncs its folder.

    Raises:
        OSError: The disk refuses; the file that was there before is as it was.
    """
    partial = path.with_name(path.name + PARTIAL_SUFFIX)
    with partial.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    reach(Failpoint.FILE_WRITTEN)
    partial.replace(path)
    sync_folder(path.parent)


def require_new(path: Path) -> None:
    """Refuses a folder that `new_folder` cannot make, before long work for it begins.

    Raises:
        StorageError: Something of that name is there, or another process is making it.
    """
    partial = path.with_name(path.name + PARTIAL_SUFFIX)
    for each, hint in (
        (path, "name another one"),
        (partial, "wait for the process that fills it, or remove what a killed one has left"),
    ):
        if each.exists():
            raise StorageError(f"{each}: expected a folder that is not there yet; {hint}")


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Gives a folder to fill under another name; it is renamed when all went well, else removed.

    Nothing is ever overwritten.

    Raises:
        StorageError: Something of that name is there, or the disk refuses.
    """
    require_new(path)
    partial = path.with_name(path.name + PARTIAL_SUFFIX)
    try:
        partial.mkdir(parents=True)
        try:
            yield partial
            _sync_all(partial)
            partial.rename(path)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        sync_folder(path.parent)
    except OSError as error:
        raise StorageError(
            f"{path}: expected a disk that can be written; got {error}; free space, or name a "
            "folder on another disk"
        ) from error


def _sync_all(folder: Path) -> None:
    for each in [folder, *folder.rglob("*")]:
        sync_folder(each)  # a file's content is synced as a folder's names are


def sync_folder(folder: Path) -> None:
    """Makes names in a folder durable: files that were made or renamed.

    Raises:
        OSError: The disk refuses.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
