"""Policy snapshots on disk, by version: what late and restarted actors ask for."""

from __future__ import annotations

import re
from pathlib import Path

from broker_config.durable import write_durably
from broker_config.errors import StorageError

_NAME = re.compile(r"(\d{6,})\.safetensors")


class SnapshotStore:
    """A folder of safetensors files, one for each retained policy version."""

    def __init__(self, folder: Path) -> None:
        """Opens the folder, and makes it if it is missing.

        Raises:
            StorageError: It cannot be made.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(
                f"snapshots {folder}: expected a folder; got {error}; choose another run folder"
            ) from error
        self._folder = folder

    def put(self, version: int, weights: bytes) -> None:
        """Stores a version durably; a reader sees the whole file or none.

        Raises:
            StorageError: The disk refuses.
        """
        path = self._path(version)
        try:
            write_durably(path, weights)
        except OSError as error:
            raise StorageError(
                f"snapshot {path}: expected to write {len(weights)} bytes; got {error}; free disk "
                "space and resume"
            ) from error

    def get(self, version: int) -> bytes | None:
        """The weights of a version, or None if it is not retained."""
        try:
            return self._path(version).read_bytes()
        except FileNotFoundError:
            return None

    def versions(self) -> list[int]:
        """The retained versions, oldest first."""
        names = (_NAME.fullmatch(path.name) for path in self._folder.iterdir())
        return sorted(int(name[1]) for name in names if name)

    def retain(self, newest: int, pinned: frozenset[int]) -> None:
        """Removes all but the newest few versions and the pinned ones."""
        for version in self.versions()[:-newest]:
            if version not in pinned:
                self._path(version).unlink(missing_ok=True)

    def _path(self, version: int) -> Path:
        return self._folder / f"{version:06d}.safetensors"
