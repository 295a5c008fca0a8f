"""Files that are whole or not there, also after a power cut."""

from __future__ import annotations

import os
from pathlib import Path

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
