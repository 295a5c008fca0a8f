"""What speaks for an action is where the evidence is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from actors.grad_cam import grad_cam
from actors.networks import PreferenceNetwork, build_network
from actors.policy import Policy
from broker_config.specs import Head, NetworkSpec

N_ACTIONS = 4


def network_of(head: Head, shape: tuple[int, int, int] = (84, 84, 3)) -> PreferenceNetwork:
    return build_network(NetworkSpec(shape, N_ACTIONS, head, 1.0), 3, starts_at_zero_value=True)


def rising_with_light() -> PreferenceNetwork:
    """Whose preferences rise with every bright pixel, and see nothing in the dark."""
    network = network_of("plain")
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            parameter.abs_() if name.endswith("weight") else parameter.zero_()
    return network


@pytest.mark.parametrize(("row", "column"), [(8, 8), (8, 76), (76, 8), (60, 40)])
def test_the_only_light_is_what_speaks_for_an_action(row: int, column: int) -> None:
    picture = np.zeros((84, 84, 3), np.uint8)
    picture[row - 6 : row + 6, column - 6 : column + 6] = 255
    heat = grad_cam(rising_with_light(), picture, action=2)
    assert heat.shape == (84, 84)
    assert heat.dtype == np.float32
    assert heat.max() == 1.0
    hottest_row, hottest_column = np.unravel_index(heat.argmax(), heat.shape)
    # A place of the last convolution sees 36 pixels, 8 apart.
    assert abs(hottest_row - row) <= 20
    assert abs(hottest_column - column) <= 20
    assert heat[84 - row, 84 - column] < 0.3 or (row, column) == (60, 40)


def test_nothing_speaks_for_an_action_in_the_dark() -> None:
    heat = grad_cam(rising_with_light(), np.zeros((84, 84, 3), np.uint8), action=0)
    assert not heat.any()


def test_what_speaks_against_an_action_is_not_shown() -> None:
    network = rising_with_light()
    with torch.no_grad():
        network.action_output.weight.neg_()
    picture = np.full((84, 84, 3), 255, np.uint8)
    assert not grad_cam(network, picture, action=0).any()


@pytest.mark.parametrize("head", ["plain", "dueling-penalty", "dueling-exact", "dueling-mean"])
def test_a_policy_of_any_head_says_what_it_looks_at(head: Head) -> None:
    network = network_of(head, (84, 84, 1))
    policy = Policy(network.spec, network.state_dict())
    picture = np.random.default_rng(0).integers(0, 256, (84, 84, 1), np.uint8)
    heats = [policy.attention(picture, action) for action in range(N_ACTIONS)]
    assert all(np.isfinite(heat).all() and heat.min() >= 0 and heat.max() <= 1 for heat in heats)
    assert any((heats[0] != heat).any() for heat in heats[1:])
    preferences = policy.preferences(picture)
    assert np.array_equal(policy.preferences(picture), preferences)  # asking changes nothing
