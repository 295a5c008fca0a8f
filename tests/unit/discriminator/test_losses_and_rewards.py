"""Losses and rewards against numbers computed by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from broker_config.preset import DiscriminatorPreset
from deploy.presets import load_preset
from discriminator.losses import (
    accuracy,
    discriminator_loss,
    gradient_penalty,
    non_negative_loss,
)
from discriminator.networks import build_discriminator
from discriminator.rewards import discriminator_reward, join_rewards


def plain() -> DiscriminatorPreset:
    imitation = load_preset("reaching-ch4-horizon30").imitation
    assert imitation is not None
    return replace(imitation.discriminator, centre_rewards=False)


def minus_log(probability: float) -> float:
    return -math.log(probability)


def logit(probability: float) -> float:
    return math.log(probability / (1 - probability))


def test_the_loss_is_that_of_equations_4_12_and_4_13() -> None:
    generated = torch.tensor([logit(0.2), logit(0.6)])
    real = torch.tensor([logit(0.9), logit(0.5)])
    expected = (minus_log(0.8) + minus_log(0.4)) / 2 + (minus_log(0.9) + minus_log(0.5)) / 2
    assert discriminator_loss(generated, real).item() == pytest.approx(expected)


def test_no_logit_overflows() -> None:
    far = torch.tensor([200.0, -200.0])
    assert discriminator_loss(far, far).item() == pytest.approx(200.0)
    assert discriminator_reward(far, bound=5.0).tolist() == [5.0, 0.0]


def test_unlabelled_states_are_no_evidence_against_targets() -> None:
    generated, real = torch.tensor([logit(0.3)]), torch.tensor([logit(0.8)])
    prior = 0.1
    false = minus_log(0.7) - prior * minus_log(0.2)
    expected = prior * minus_log(0.8) + false
    assert non_negative_loss(generated, real, prior).item() == pytest.approx(expected)
    # Where more generated states look like targets than the prior allows, they cost nothing.
    surely_false = torch.tensor([logit(1e-6)])
    assert non_negative_loss(surely_false, real, 0.5).item() == pytest.approx(0.5 * minus_log(0.8))


def test_accuracy_counts_both_sides_alike() -> None:
    assert accuracy(torch.tensor([-1.0, -1.0, 1.0, 1.0]), torch.tensor([1.0])) == 0.75


def test_rewards_are_those_of_equation_4_3() -> None:
    expert = torch.tensor([logit(0.5), logit(0.9)])
    target = torch.tensor([logit(0.1), logit(0.2)])
    expected = [minus_log(0.5) + minus_log(0.9), minus_log(0.1) + minus_log(0.8)]
    assert join_rewards([expert, target], plain()).tolist() == pytest.approx(expected)
    assert join_rewards([expert], plain()).tolist() == pytest.approx(
        [minus_log(0.5), minus_log(0.1)]
    )


def test_rewards_can_be_centred_and_brought_to_one_spread() -> None:
    generator = torch.Generator().manual_seed(0)
    expert = 3 * torch.randn(500, generator=generator)
    target = 0.01 * torch.randn(500, generator=generator)
    centred = join_rewards([expert, target], replace(plain(), centre_rewards=True))
    assert centred.mean().item() == pytest.approx(0.0, abs=1e-5)
    uncentred = join_rewards([expert, target], plain())
    torch.testing.assert_close(centred, uncentred - uncentred.mean())
    alike = join_rewards([expert, target], replace(plain(), normalise_each=True))
    # Each now has a spread of 1, and they are independent.
    assert alike.std().item() == pytest.approx(math.sqrt(2), rel=0.1)
    constant = join_rewards([torch.zeros(5)], replace(plain(), normalise_each=True))
    assert torch.isfinite(constant).all()


def test_the_penalty_is_the_squared_gradient_by_the_pictures() -> None:
    network = build_discriminator((36, 36, 1), seed=0, spectral_norm=False).double()
    pictures = torch.rand((2, 1, 36, 36), generator=torch.Generator().manual_seed(0)).double()
    squares = []
    for picture in pictures:
        step = 1e-6
        changes = []
        for pixel in range(36 * 36):
            moved = picture.clone()
            moved.view(-1)[pixel] += step
            changes.append((network(moved[None]) - network(picture[None])).item() / step)
        squares.append(sum(change**2 for change in changes))
    expected = sum(squares) / 2
    assert gradient_penalty(network, pictures).item() == pytest.approx(expected, rel=1e-3)
