"""The rule by which an arm reaches, and the mistakes that make a demonstrator imperfect."""

import numpy as np
from numpy.typing import NDArray

from actors.envs.planar_arm import (
    INCREMENTS_RAD,
    apply_action,
    end_effector_m,
    reaching_reward,
)


def scripted_reach_action(joint_angles_rad: NDArray[np.float64]) -> int:
    """The action after which the reward of reaching is highest; of equals the first.

    Args:
        joint_angles_rad: f64[n], as in the environment's `info`.
    """
    n_actions = len(joint_angles_rad) * len(INCREMENTS_RAD)
    after_rad = np.stack([apply_action(joint_angles_rad, action) for action in range(n_actions)])
    # Rounded, so that the last bit of a sine does not choose between two joints.
    return int(reaching_reward(end_effector_m(after_rad)).round(9).argmax())


def imperfect_action(
    action: int, n_actions: int, mistake_rate: float, random: np.random.Generator
) -> int:
    """The action, or with a probability one of all actions at random.

    Raises:
        ValueError: the rate is not a probability.
    """
    if not 0.0 <= mistake_rate <= 1.0:
        raise ValueError(
            f"mistake_rate: expected a probability from 0 to 1; got {mistake_rate}; "
            "0 gives the demonstrator unchanged"
        )
    # Both are drawn always, so that one mistake more or less does not change the later ones.
    mistaken = random.random() < mistake_rate
    anything = int(random.integers(n_actions))
    return anything if mistaken else action
