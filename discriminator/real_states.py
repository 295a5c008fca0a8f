"""What is real to the discriminators: demonstrated states, and the targets among them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from broker_config.errors import MessageError
from broker_config.messages import Trajectory
from discriminator.trainer import Positives


def real_states(
    demonstrations: Sequence[Trajectory], target_reward: float | None
) -> dict[Positives, Tensor]:
    """Pictures of demonstrated states and of targets, u8[n, H, W, C] each.

    Rewards belong to the states that transitions lead into: the first picture of an episode, which
    every policy begins with, is none of them.

    Args:
        demonstrations: At least one.
        target_reward: A state is a target where its task reward is at least this; with None the
            last state of each demonstration that succeeded at its end is one.

    Raises:
        MessageError: There are no demonstrations. There may be no targets: who needs them, says so.
    """
    if not demonstrations:
        raise MessageError("imitation: expected demonstrations; got none; record some")
    reached = np.concatenate([each.observations[1:] for each in demonstrations])
    if target_reward is None:
        ends = [np.arange(each.steps) == each.steps - 1 for each in demonstrations]
        is_target = np.concatenate(
            [end & each.success for end, each in zip(ends, demonstrations, strict=True)]
        )
    else:
        rewards = np.concatenate([each.rewards for each in demonstrations])
        is_target = rewards >= target_reward
    return {"expert": torch.tensor(reached), "target": torch.tensor(reached[is_target])}
