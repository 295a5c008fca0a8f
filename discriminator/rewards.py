"""Rewards from what discriminators say of the states that a policy has reached."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import softplus

from broker_config.preset import DiscriminatorPreset


def discriminator_reward(logits: Tensor, bound: float) -> Tensor:
    """-log(1 - D(s')), at most the bound: a discriminator's part of eq. 4.3.

    Args:
        logits: Of the states after each transition, f32[n].
        bound: Of the reward, which is never negative.
    """
    return softplus(logits).clamp_max(bound)


def join_rewards(logits: Sequence[Tensor], preset: DiscriminatorPreset) -> Tensor:
    """r = -log(1 - D_E(s')) - log(1 - D_T(s')) of every sample of D_G, f32[n].

    Source: eq. 4.3. Differs: bounded; centred over D_G and of equal spread where the preset says
    so.

    Args:
        logits: Of each discriminator that takes part, f32[n].
        preset: Says how they are joined.
    """
    parts = [discriminator_reward(each, preset.reward_bound) for each in logits]
    if preset.normalise_each:
        tiny = torch.finfo(torch.float32).eps
        parts = [part / part.std(correction=0).clamp_min(tiny) for part in parts]
    total = torch.stack(parts).sum(0)
    return total - total.mean() if preset.centre_rewards else total
