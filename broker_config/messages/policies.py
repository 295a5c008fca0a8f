"""Policies: snapshots of weights, by version."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from broker_config.messages.rules import require, require_count, require_digest
from broker_config.specs import NetworkSpec


@dataclass(frozen=True)
class Snapshot:
    """A policy, by version."""

    version: int
    """Updates made so far; 0 is the policy before the first episode."""
    owner_epoch: int
    network: NetworkSpec
    weights: bytes
    """safetensors."""
    digest: str
    """SHA-256 of `weights`."""

    def __post_init__(self) -> None:
        require_count("snapshot.version", self.version)
        require_digest("snapshot.digest", self.digest)
        actual = weights_digest(self.weights)
        require(self.digest == actual, "snapshot.digest", f"{actual} (of weights)", self.digest)


def weights_digest(weights: bytes) -> str:
    """SHA-256 of safetensors bytes, in hexadecimal."""
    return hashlib.sha256(weights).hexdigest()


@dataclass(frozen=True)
class SnapshotRequest:
    """An actor asks for exactly one version."""

    version: int

    def __post_init__(self) -> None:
        require_count("snapshot_request.version", self.version)
