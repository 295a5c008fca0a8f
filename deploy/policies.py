"""Policies that run folders hold."""

from __future__ import annotations

from actors.policy import Policy
from broker_config.errors import StorageError
from broker_config.preset import Preset
from deploy.run_folder import RunFolder
from learner.snapshots import SnapshotStore


def newest_policy(folder: RunFolder, preset: Preset) -> Policy:
    """The newest policy that a run folder holds.

    Raises:
        StorageError: It holds none.
    """
    store = SnapshotStore(folder.snapshots)
    versions = store.versions()
    weights = store.get(versions[-1]) if versions else None
    if weights is None:
        raise StorageError(f"{folder.path}: expected a policy; got none; let the run begin first")
    return Policy.from_bytes(preset.network, weights)
