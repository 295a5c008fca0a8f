"""Behaviour cloning, of pictures as they are and of augmented ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from actors.policy import Policy
from broker_config.errors import MessageError
from broker_config.messages import Trajectory
from deploy.presets import load_preset
from discriminator.augmentation import random_shift
from discriminator.networks import as_input
from learner.cloning import Cloned, clone, cloning_preset

PRESET = load_preset(
    "reaching-ch4-horizon30",
    [
        "task.observation_shape=[36,36,3]",
        "task.options.n_joints=1",
        "task.n_actions=4",
        "schedule.minibatch_size=8",
        "optimiser.name=adam",
        "optimiser.learning_rate=1e-3",
        "optimiser.epsilon=1e-8",
    ],
)
assert PRESET.imitation is not None
AUGMENTATION = replace(PRESET.imitation.discriminator, random_shift_px=4, colour_jitter=0.2)
NOTHING = replace(AUGMENTATION, random_shift_px=0, colour_jitter=0.0)


@pytest.fixture
def demonstrations(make_trajectory) -> list[Trajectory]:
    """A bright square on black at one of four heights says which action is right."""
    actions = np.tile(np.arange(4, dtype=np.int32), 4)
    observations = np.zeros((17, 36, 36, 3), np.uint8)
    for step, action in enumerate(actions):
        observations[step, 5 + 7 * action : 9 + 7 * action, 14:22] = 200
    return [replace(make_trajectory(steps=16), observations=observations, actions=actions)]


def right(cloned: Cloned, pictures: torch.Tensor, actions: np.ndarray) -> float:
    """Portion of pictures u8[n, H, W, C] on which the policy does what was demonstrated."""
    policy = Policy(cloning_preset(PRESET).network, cloned.weights)
    chosen = [policy.greedy(picture) for picture in pictures.numpy()]
    return float(np.mean(np.array(chosen) == actions))


def test_augmentation_holds_where_pictures_are_shifted(demonstrations: list[Trajectory]) -> None:
    seen, actions = torch.tensor(demonstrations[0].observations[:-1]), demonstrations[0].actions
    shifted = random_shift(as_input(seen), 3, torch.Generator().manual_seed(5))
    shifted_pictures = (255 * shifted).round().to(torch.uint8).permute(0, 2, 3, 1)
    plain, augmented = (clone(PRESET, demonstrations, 60, it) for it in (None, AUGMENTATION))
    assert plain.gradient_steps == augmented.gradient_steps == 60 * 2
    assert right(plain, seen, actions) == 1.0
    assert right(augmented, shifted_pictures, actions) > right(plain, shifted_pictures, actions)


def test_augmentation_by_nothing_changes_nothing(demonstrations: list[Trajectory]) -> None:
    plain, same = (clone(PRESET, demonstrations, 3, it) for it in (None, NOTHING))
    assert plain.loss == pytest.approx(same.loss, rel=1e-4)
    again = clone(PRESET, demonstrations, 3, AUGMENTATION)
    assert again.loss == clone(PRESET, demonstrations, 3, AUGMENTATION).loss != plain.loss


def test_nothing_can_be_cloned_from_nothing() -> None:
    with pytest.raises(MessageError, match="cloning: expected demonstrations; got none"):
        clone(PRESET, [], 1)
