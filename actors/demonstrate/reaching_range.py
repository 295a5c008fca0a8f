"""Between which returns demonstrations of reaching lie: chance, and the best that is known."""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.envs.planar_arm import INCREMENTS_RAD, end_effector_m, reaching_reward

BEAM_WIDTH: Final = 1000
_MOST_WAYS: Final = 25
"""To a pose, for which room is left among those that are looked at."""
_CHANCE_EPISODES: Final = 2000


@cache
def best_reaching_return(n_joints: int, horizon: int, width: int = BEAM_WIDTH) -> float:
    """The highest return that beam search finds, without discount.

    Kept are the poses whose return would be highest if the arm stayed there.

    Args:
        n_joints: Of the arm.
        horizon: Steps of an episode.
        width: Poses that are kept after each step.
    """
    moves_rad = _moves_rad(n_joints)
    poses_rad, returns = np.zeros((1, n_joints)), np.zeros(1)
    for steps_left in reversed(range(horizon)):
        after_rad = (poses_rad[:, None] + moves_rad).reshape(-1, n_joints)
        rewards = reaching_reward(end_effector_m(after_rad))
        after_returns = returns.repeat(len(moves_rad)) + rewards
        order = np.argsort(-(after_returns + steps_left * rewards), kind="stable")
        order = order[: _MOST_WAYS * width]
        # Of the ways to one pose the best, which comes first.
        _, first = np.unique(after_rad[order].round(6), axis=0, return_index=True)
        kept = order[np.sort(first)[:width]]
        poses_rad, returns = after_rad[kept], after_returns[kept]
    return float(returns.max())


@cache
def chance_reaching_return(n_joints: int, horizon: int) -> float:
    """The mean return of random actions, without discount, over 2000 episodes."""
    random = np.random.default_rng(0)
    moves_rad = _moves_rad(n_joints)
    actions = random.integers(len(moves_rad), size=(_CHANCE_EPISODES, horizon))
    poses_rad = np.cumsum(moves_rad[actions], axis=1)
    return float(reaching_reward(end_effector_m(poses_rad)).sum(axis=1).mean())


def _moves_rad(n_joints: int) -> NDArray[np.float64]:
    """What each action adds to the angles, f64[5 n, n]."""
    return np.kron(np.eye(n_joints), np.array(INCREMENTS_RAD)[:, None])
