"""Where links and fingers are for joint angles: compiled. Robot frame, metres.

PyBullet says the same of the robot's URDF, about three hundred times more slowly.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from actors.compiled import compiler
from actors.robot.model import ARMS, GRIPPER_LENGTH_M, JOINTS, Arm, arm_joints

compiled: Any = compiler()

_LINK_NAMES = [joint.link for joint in JOINTS]
PARENTS: Final = np.array(
    [_LINK_NAMES.index(it.parent) if it.parent in _LINK_NAMES else -1 for it in JOINTS]
)
"""i64[15], the link before each; -1 is the waist."""

AXES: Final = np.array([joint.axis.index(1) for joint in JOINTS])
"""i64[15], the axis of its own frame around which each link turns."""

HANDS: Final = np.array([arm_joints(arm)[-1] for arm in ARMS])
"""i64[2], the link of each arm that holds its gripper; it turns around the gripper's own axis."""

_ORIGINS_M = np.array([joint.origin_m for joint in JOINTS])
_ROLLS_RAD = np.array([joint.roll_rad for joint in JOINTS])


def link_frames(joints_rad: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations f64[15, 3, 3] and origins f64[15, 3] of all links, for angles f64[15]."""
    rotations, places = np.empty((len(JOINTS), 3, 3)), np.empty((len(JOINTS), 3))
    fill_frames(joints_rad, rotations, places)
    return rotations, places


def fingertips_in_robot(joints_rad: NDArray[np.float64], arm: Arm) -> NDArray[np.float64]:
    """Where an arm's fingers are, f64[K, 3], for joint angles f64[K, 15]."""
    tips: NDArray[np.float64] = _tips(np.ascontiguousarray(joints_rad), HANDS[ARMS.index(arm)])
    return tips


@compiled
def fill_frames(joints, rotations, places):  # type: ignore[no-untyped-def]
    """Write rotations f64[15, 3, 3] and origins f64[15, 3] of all links for angles f64[15]."""
    for j in range(len(joints)):
        parent = PARENTS[j]
        for row in range(3):
            place = 0.0
            for column in range(3):
                before = 1.0 if row == column else 0.0
                if parent >= 0:
                    before = rotations[parent, row, column]
                rotations[j, row, column] = before
                place += before * _ORIGINS_M[j, column]
            places[j, row] = place if parent < 0 else place + places[parent, row]
        if _ROLLS_RAD[j] != 0.0:
            _turn(rotations, j, 0, _ROLLS_RAD[j])
        _turn(rotations, j, AXES[j], joints[j])


@compiled
def _turn(rotations, j, axis, angle):  # type: ignore[no-untyped-def]
    """Turn frame j around an axis of its own."""
    sine, cosine = np.sin(angle), np.cos(angle)
    one, two = (axis + 1) % 3, (axis + 2) % 3
    for row in range(3):
        a, b = rotations[j, row, one], rotations[j, row, two]
        rotations[j, row, one] = cosine * a + sine * b
        rotations[j, row, two] = cosine * b - sine * a


@compiled
def _tips(joints, hand):  # type: ignore[no-untyped-def]
    tips = np.empty((len(joints), 3))
    rotations, places = np.empty((joints.shape[1], 3, 3)), np.empty((joints.shape[1], 3))
    for k in range(len(joints)):
        fill_frames(joints[k], rotations, places)
        for row in range(3):
            tips[k, row] = places[hand, row] - GRIPPER_LENGTH_M * rotations[hand, row, 0]
    return tips
