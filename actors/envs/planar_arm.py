"""The planar arm of the reaching task: its angles, its joints, its reward.

Frame: the base at (0, 0), x to the right, y upwards. The arm has length 1 whatever the number of
its joints. Angles are relative to the limb before, and the first to the vertical; a positive angle
turns clockwise, towards the target. The source's optimum for two joints, about (50, 90) degrees,
lies near the target with these signs only.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

INCREMENTS_RAD: Final = (-0.0875, -0.0175, 0.0, 0.0175, 0.0875)
"""What one action adds to one joint. Source: table 3.1a."""

TARGET_M: Final = (0.6830, 0.0)
"""Where the end effector shall be. Source: table 3.1a."""

SUCCESS_DISTANCE_M: Final = 0.1
"""Nearer than this is a target state. Source: table 4.1a."""


def joint_positions_m(joint_angles_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """The base, each joint after it and the end effector, f64[n + 1, 2], for angles f64[n]."""
    n_joints = len(joint_angles_rad)
    from_vertical_rad = np.cumsum(joint_angles_rad)
    limbs_m = np.stack([np.sin(from_vertical_rad), np.cos(from_vertical_rad)], axis=1) / n_joints
    return np.concatenate([np.zeros((1, 2)), np.cumsum(limbs_m, axis=0)])


def end_effector_m(joint_angles_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """The end effectors of one arm, f64[2] for f64[n], or of many, f64[..., 2] for f64[..., n]."""
    n_joints = joint_angles_rad.shape[-1]
    from_vertical_rad = np.cumsum(joint_angles_rad, axis=-1)
    x_m = np.sin(from_vertical_rad).sum(axis=-1) / n_joints
    y_m = np.cos(from_vertical_rad).sum(axis=-1) / n_joints
    return np.stack([x_m, y_m], axis=-1)


def reaching_reward(effector_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """-(abs(X - 0.6830) + abs(Y)), f64[...], for end effectors f64[..., 2].

    Source: table 3.1a, with the absolute values of figure 4.6's text.
    """
    return -np.asarray(np.abs(effector_m - np.array(TARGET_M)).sum(axis=-1))


def distance_m(effector_m: NDArray[np.float64]) -> float:
    """Straight distance of one end effector, f64[2], from the target."""
    return float(np.linalg.norm(effector_m - np.array(TARGET_M)))


def apply_action(joint_angles_rad: NDArray[np.float64], action: int) -> NDArray[np.float64]:
    """The angles after an action, f64[n]: action = joint * 5 + index into `INCREMENTS_RAD`."""
    joint, increment = divmod(action, len(INCREMENTS_RAD))
    moved_rad = joint_angles_rad.copy()
    moved_rad[joint] += INCREMENTS_RAD[increment]
    return moved_rad
