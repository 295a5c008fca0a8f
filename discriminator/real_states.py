"""What is real to the discriminators: demonstrated states, and the targets among them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from broker_config.errors import MessageError
from broker_config.messages import TargetsMarked, Trajectory
from broker_config.preset import ImitationPreset
from discriminator.targets import target_states
from discriminator.trainer import Positives


def real_states(
    demonstrations: Sequence[Trajectory],
    target_reward: float | None,
    marks: Sequence[TargetsMarked] | None = None,
) -> dict[Positives, Tensor]:
    """Pictures of demonstrated states and of targets, u8[n, H, W, C] each.

    Rewards belong to the states that transitions lead into: the first picture of an episode, which
    every policy begins with, is none of them.

    Args:
        demonstrations: At least one.
        target_reward: The rule for targets where nobody marked any: see `target_states`.
        marks: A person's; where they are not None they decide alone.

    Raises:
        MessageError: There are no demonstrations, or a mark is of none of them. There may be no
            targets: who needs them, says so.
    """
    if not demonstrations:
        raise MessageError("imitation: expected demonstrations; got none; record some")
    reached = np.concatenate([each.observations[1:] for each in demonstrations])
    is_target = np.concatenate(target_states(demonstrations, target_reward, marks))
    return {"expert": torch.tensor(reached), "target": torch.tensor(reached[is_target])}


def require_real_states(
    imitation: ImitationPreset,
    demonstrations: Sequence[Trajectory],
    marks: Sequence[TargetsMarked] | None,
) -> None:
    """Refuses demonstrations that D_T could learn nothing from, before a run begins.

    Raises:
        MessageError: D_T takes part, and there are no targets; or there are no demonstrations.
    """
    targets = real_states(demonstrations, imitation.target_reward, marks)["target"]
    if imitation.discriminators != "expert" and len(targets) == 0:
        rule = (
            "that succeed at their end"
            if imitation.target_reward is None
            else f"with a state of task reward {imitation.target_reward:g} or more"
        )
        raise MessageError(
            f"imitation: expected demonstrations {rule}; got {len(demonstrations)} without; D_T "
            "has no targets then: demonstrate more, or with fewer mistakes"
        )
