"""Between which returns demonstrations of reaching lie."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from actors.demonstrate.reaching_range import best_reaching_return, chance_reaching_return
from actors.demonstrate.scripted import scripted_reach_action
from actors.envs.planar_arm import apply_action, end_effector_m, reaching_reward

N_JOINTS = 2


def played_return(actions: list[int] | tuple[int, ...]) -> float:
    pose_rad, total = np.zeros(N_JOINTS), 0.0
    for action in actions:
        pose_rad = apply_action(pose_rad, action)
        total += float(reaching_reward(end_effector_m(pose_rad)))
    return total


def test_the_best_of_a_short_episode_is_the_best_of_all_ways() -> None:
    everything = [played_return(actions) for actions in product(range(10), repeat=3)]
    assert best_reaching_return(N_JOINTS, 3) == pytest.approx(max(everything))


def test_the_best_is_better_than_the_script_that_looks_one_step_ahead() -> None:
    pose_rad, actions = np.zeros(N_JOINTS), []
    for _ in range(30):
        actions.append(scripted_reach_action(pose_rad))
        pose_rad = apply_action(pose_rad, actions[-1])
    assert played_return(actions) < best_reaching_return(N_JOINTS, 30) < 0.0


def test_chance_is_the_mean_of_random_episodes() -> None:
    everything = [played_return(actions) for actions in product(range(10), repeat=2)]
    assert chance_reaching_return(N_JOINTS, 2) == pytest.approx(np.mean(everything), abs=0.01)
