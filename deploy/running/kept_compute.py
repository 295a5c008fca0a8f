"""By which path a run is trained: decided once, so that a restart changes no weights."""

from __future__ import annotations

from broker_config.durable import write_durably
from broker_config.errors import StorageError
from deploy.run_folder import RunFolder
from learner.steps.compute import Compute


def settle_compute(folder: RunFolder, asked: Compute) -> Compute:
    """What a run is trained on: as it was begun, or what is asked for where it begins now.

    Raises:
        StorageError: Another path or device is asked for than it was begun with, or the folder
            cannot be read or written.
    """
    begun = _read_or_write(folder, str(asked))
    try:
        return asked.as_begun(begun)
    except StorageError as error:
        raise StorageError(
            f"{folder.path}: {error}; to go on by another all the same, remove {folder.compute}"
        ) from error


def _read_or_write(folder: RunFolder, asked: str) -> str:
    try:
        if folder.compute.exists():
            return folder.compute.read_text().strip()
        write_durably(folder.compute, f"{asked}\n".encode())
    except OSError as error:
        raise StorageError(
            f"{folder.compute}: expected to keep how the run is trained; got {error}"
        ) from error
    return asked
