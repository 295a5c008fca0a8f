"""What each discriminator's part of the reward was, iteration by iteration."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from broker_config.messages import IterationAnnounced, Rewards, Trajectory, TrajectoryId
from broker_config.preset import Preset
from discriminator.labelling import snapshot_of
from discriminator.rewards import discriminator_reward
from discriminator.stored import StoredDiscriminators

MOST_SCORED: Final = 60
"""Iterations whose states are scored again, evenly spread."""
SCORED_STATES: Final = 128
"""Of each of them, the newest of D_G."""
_KEPT_BYTES: Final = 32 << 20


@dataclass(frozen=True)
class RewardedIteration:
    """An iteration whose samples discriminators have labelled."""

    iteration: int
    rewards_mean: float
    """Of all of D_G, as it was learned from: centred, where the preset says so."""
    rewards_std: float
    parts: Mapping[str, float]
    """Mean of -log(1 - D) (eq. 4.3) over the newest states of D_G, by discriminator; empty where
    they were not scored again."""
    numbers: Mapping[str, float]
    """What the update did: loss, accuracy and epochs of each discriminator."""


class CompositionLog:
    """Folds announcements and rewards; of the trajectories, the newest few are in memory.

    Rewards carry the state of the discriminators that gave them: they can be asked again.
    """

    def __init__(self, preset: Preset) -> None:
        self._preset = preset
        self._every = math.ceil(preset.schedule.iterations / MOST_SCORED)
        self._states: OrderedDict[TrajectoryId, NDArray[np.uint8]] = OrderedDict()
        self._kept_bytes = 0
        self._announced: IterationAnnounced | None = None
        self.rows: list[RewardedIteration] = []
        self.newest: Rewards | None = None

    def take(self, trajectory: Trajectory) -> None:
        """Takes a trajectory that counts."""
        if self._preset.imitation is None:
            return
        after = trajectory.observations[1:]
        self._states[trajectory.id] = after
        self._kept_bytes += after.nbytes
        while self._kept_bytes > _KEPT_BYTES and len(self._states) > 1:
            self._kept_bytes -= self._states.popitem(last=False)[1].nbytes

    def announce(self, announced: IterationAnnounced) -> None:
        """Takes what waits for rewards."""
        self._announced = announced

    def reward(self, rewards: Rewards) -> None:
        """Takes the rewards."""
        self.newest = rewards
        is_scored = rewards.iteration % self._every == 0
        states = self._newest_states() if is_scored else None
        parts = {} if states is None else mean_parts(self._preset, rewards, states)
        self.rows.append(
            RewardedIteration(
                rewards.iteration,
                float(rewards.rewards.mean()),
                float(rewards.rewards.std()),
                parts,
                dict(rewards.numbers),
            )
        )

    def _newest_states(self) -> NDArray[np.uint8] | None:
        """u8[n, H, W, C], of the announced samples the newest; None if none is in memory."""
        found: list[NDArray[np.uint8]] = []
        for id_ in reversed(self._announced.trajectories if self._announced else ()):
            if id_ not in self._states or sum(map(len, found)) >= SCORED_STATES:
                break
            found.append(self._states[id_])
        return np.concatenate(found)[:SCORED_STATES] if found else None


def reward_parts(
    preset: Preset, rewards: Rewards, states: NDArray[np.uint8]
) -> dict[str, NDArray[np.float32]]:
    """-log(1 - D(s')) by discriminator, bounded as the preset says, f32[n].

    Args:
        preset: Of the run, with an [imitation] table.
        rewards: Whose discriminators are asked.
        states: u8[n, H, W, C], n at least 1.
    """
    assert preset.imitation is not None  # nobody else has rewards
    bound = preset.imitation.discriminator.reward_bound
    stored = StoredDiscriminators(preset, snapshot_of(rewards).weights)
    logits = stored.logits(torch.tensor(states))
    return {name: discriminator_reward(it, bound).numpy() for name, it in logits.items()}


def mean_parts(preset: Preset, rewards: Rewards, states: NDArray[np.uint8]) -> dict[str, float]:
    """Means of `reward_parts`."""
    parts = reward_parts(preset, rewards, states)
    return {name: float(part.mean()) for name, part in parts.items()}
