"""Policies that run folders hold."""

from __future__ import annotations

from dataclasses import dataclass

from actors.policy import Policy
from broker_config.errors import StorageError
from broker_config.messages import weights_digest
from broker_config.preset import Preset
from deploy.run_folder import RunFolder
from learner.snapshots import SnapshotStore


@dataclass(frozen=True)
class KeptPolicy:
    """A policy version of a run."""

    version: int
    digest: str
    """SHA-256 of its weights."""
    policy: Policy


def kept_policy(folder: RunFolder, preset: Preset, version: int | None = None) -> KeptPolicy:
    """A policy that a run folder holds.

    Args:
        folder: Of the run.
        preset: Of the run.
        version: Which one; the newest if None.

    Raises:
        StorageError: It does not hold it, or none at all.
    """
    store = SnapshotStore(folder.snapshots)
    versions = store.versions()
    if not versions:
        raise StorageError(f"{folder.path}: expected a policy; got none; let the run begin first")
    chosen = versions[-1] if version is None else version
    weights = store.get(chosen)
    if weights is None:
        raise StorageError(
            f"{folder.path}: expected one of the policy versions {', '.join(map(str, versions))}, "
            f"which are kept; got {chosen}; choose one of them"
        )
    policy = Policy.from_bytes(preset.network, weights)
    return KeptPolicy(chosen, weights_digest(weights), policy)


def newest_policy(folder: RunFolder, preset: Preset) -> Policy:
    """The newest policy that a run folder holds.

    Raises:
        StorageError: It holds none.
    """
    return kept_policy(folder, preset).policy
