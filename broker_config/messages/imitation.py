"""Imitation: which samples wait for rewards, and the rewards that discriminators give them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from broker_config.messages.rules import (
    require,
    require_array,
    require_count,
    require_digest,
    require_id,
)
from broker_config.messages.trajectories import TrajectoryId


@dataclass(frozen=True)
class IterationAnnounced:
    """Journal: an iteration is collected, and every sample of D_G waits for a reward (Algorithm 4).

    Whoever follows the journal has all of D_G by then: trajectories come before it.
    """

    iteration: int
    digest: str
    """Of `generated_digest`: names D_G."""
    samples: int
    """Of D_G: the newest so many of the trajectories."""
    trajectories: tuple[TrajectoryId, ...]
    """That D_G's samples are of, oldest first; the first may have lost its oldest samples."""

    def __post_init__(self) -> None:
        require_count("iteration_announced.iteration", self.iteration)
        subject = "iteration_announced.samples"
        n_trajectories = len(self.trajectories)
        is_enough = self.samples >= n_trajectories >= 1
        require(is_enough, subject, f"at least one of each of {n_trajectories}", self.samples)
        actual = generated_digest(self.trajectories, self.samples)
        subject = "iteration_announced.digest"
        require(self.digest == actual, subject, f"{actual} (of trajectories)", self.digest)


def generated_digest(trajectories: Sequence[TrajectoryId], samples: int) -> str:
    """SHA-256 over the ids of D_G's trajectories, oldest first, and the number of its samples."""
    lines = [*map(str, trajectories), str(samples)]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


@dataclass(frozen=True)
class Rewards:
    """What an iteration's samples have earned, and the discriminators that say so.

    The state goes with them, so that the journal alone is enough to go on from, or to audit.
    """

    discriminator: str
    """Id of the process."""
    incarnation: str
    iteration: int
    digest: str
    """Of the D_G that was announced."""
    rewards: NDArray[np.float32]
    """f32[n], finite: of every sample of D_G, oldest first."""
    expert_version: int | None
    """Updates made of D_E; None where it takes no part."""
    target_version: int | None
    """Updates made of D_T; None where it takes no part."""
    state: bytes
    """safetensors: weights, optimisers and random states after the update."""
    state_digest: str
    """SHA-256 of `state`."""
    numbers: Mapping[str, float]
    """What the update did: loss, accuracy and epochs of each, spread of the rewards."""

    def __post_init__(self) -> None:
        require_id("rewards.discriminator", self.discriminator)
        require_id("rewards.incarnation", self.incarnation)
        require_count("rewards.iteration", self.iteration)
        require_digest("rewards.digest", self.digest)
        require_array("rewards.rewards", self.rewards, "float32", (None,))
        finite = bool(np.isfinite(self.rewards).all())
        require(finite, "rewards.rewards", "finite numbers", "some that are not")
        _require_versions("rewards", self.expert_version, self.target_version)
        actual = hashlib.sha256(self.state).hexdigest()
        subject = "rewards.state_digest"
        require(self.state_digest == actual, subject, f"{actual} (of state)", self.state_digest)

    def is_same_as(self, other: Rewards) -> bool:
        """Whether both say the same of the same samples, whichever process they came from."""
        mine = self.iteration, self.digest, self.state_digest
        theirs = other.iteration, other.digest, other.state_digest
        return mine == theirs and np.array_equal(self.rewards, other.rewards)


@dataclass(frozen=True)
class RewardsAck:
    """The owner has committed an iteration's rewards to its journal."""

    iteration: int
    owner_epoch: int
    offset: int
    """Where in the journal they are."""
    duplicate: bool
    """They were there already; nothing was added."""

    def __post_init__(self) -> None:
        require_count("rewards_ack.iteration", self.iteration)
        require_count("rewards_ack.offset", self.offset)


@dataclass(frozen=True)
class DiscriminatorSnapshot:
    """The newest discriminators, for whoever looks at what they reward."""

    discriminator: str
    iteration: int
    expert_version: int | None
    target_version: int | None
    weights: bytes
    """safetensors: of each network that takes part, names begin with `expert.` or `target.`."""
    digest: str
    """SHA-256 of `weights`."""

    def __post_init__(self) -> None:
        require_id("discriminator_snapshot.discriminator", self.discriminator)
        require_count("discriminator_snapshot.iteration", self.iteration)
        _require_versions("discriminator_snapshot", self.expert_version, self.target_version)
        actual = hashlib.sha256(self.weights).hexdigest()
        subject = "discriminator_snapshot.digest"
        require(self.digest == actual, subject, f"{actual} (of weights)", self.digest)


def _require_versions(subject: str, expert: int | None, target: int | None) -> None:
    versions = expert, target
    has_one = versions != (None, None)
    require(has_one, f"{subject}.expert_version", "one or both versions", versions)
    for name, version in zip(("expert_version", "target_version"), versions, strict=True):
        require_count(f"{subject}.{name}", 0 if version is None else version)
