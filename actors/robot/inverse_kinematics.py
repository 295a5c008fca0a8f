"""Which joint angles bring the fingers somewhere: compiled. Robot frame, metres.

Damped least squares over the chest and the arms at once, since the chest carries both. A joint that
would leave its limits is held there, and the others do what they can. The last joint of an arm only
spins its gripper around the gripper's own axis: it is set so that the fingers open along the
robot's y, as in its initial pose, however chest and arm are turned.
"""

from collections.abc import Sequence
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.robot.kinematics import AXES, HANDS, compiled, fill_frames
from actors.robot.model import ARM_JOINTS, ARMS, CHEST_JOINT, GRIPPER_LENGTH_M, JOINTS, Arm

POSITION_TOLERANCE_M: Final = 0.002
MOST_TILT_RAD: Final = 0.35
"""The fingers may point so far away from straight down."""

FREE_TILT_RAD: Final = 0.3
"""Below this the fingers' place counts for more than their direction."""

MOST_ROUNDS: Final = 80
STALLED_ROUNDS: Final = 12
"""Hands that come no nearer in so many rounds will not arrive."""

CHEST_SHARE: Final = 0.5
"""How readily the chest turns, where 1 is how readily a joint of an arm does."""

LOWER_RAD: Final = np.array([joint.lower_rad for joint in JOINTS])
UPPER_RAD: Final = np.array([joint.upper_rad for joint in JOINTS])
_ENDLESS = np.full(len(JOINTS), np.inf)

_DAMPING = 0.03
_TILT_WEIGHT_M = 0.15
_FREE_TILT_SHARE = 0.2
_LARGEST_STEP_RAD = 0.25
_STEERING = ARM_JOINTS - 1
"""Joints of an arm that move or tilt its fingers: all but the last."""


class Solution(Enum):
    """How a search for joint angles ended."""

    FOUND = "found"
    BEYOND_LIMITS = "beyond_limits"
    """Only angles beyond a joint's limits would do."""

    NONE = "none"


def solve(
    joints_rad: NDArray[np.float64],
    arms: Sequence[Arm],
    points_in_robot: NDArray[np.float64],
) -> Solution:
    """Move joints until the fingers are at points and point down within the tilt allowed.

    Args:
        joints_rad: f64[15], from where to search; written to.
        arms: one or both; the chest turns for them, the other joints stay as they are.
        points_in_robot: f64[H, 3], one for each of them, contiguous.
    """
    hands = np.array([HANDS[ARMS.index(arm)] for arm in arms])
    begin = joints_rad.copy()
    if _solve(joints_rad, hands, points_in_robot, LOWER_RAD, UPPER_RAD):
        return Solution.FOUND
    if _solve(begin, hands, points_in_robot, -_ENDLESS, _ENDLESS):
        return Solution.BEYOND_LIMITS
    return Solution.NONE


@compiled
def _solve(joints, hands, points, lower, upper):  # type: ignore[no-untyped-def]
    """Move joints f64[15] until all hands are where they shall be; whether they are."""
    n_free, n_rows = 1 + _STEERING * len(hands), 6 * len(hands)
    moving = np.empty(n_free, np.int64)
    moving[0] = CHEST_JOINT
    for h in range(len(hands)):
        for k in range(_STEERING):
            moving[1 + _STEERING * h + k] = hands[h] - _STEERING + k
    rotations, places = np.empty((len(joints), 3, 3)), np.empty((len(joints), 3))
    jacobian, missing = np.zeros((n_rows, n_free)), np.zeros(n_rows)
    distances = np.empty(MOST_ROUNDS)
    for attempt in range(MOST_ROUNDS):
        fill_frames(joints, rotations, places)
        distance, is_down = _look(rotations, places, hands, points, jacobian, missing)
        if distance < POSITION_TOLERANCE_M and is_down:
            return _keep_headings(joints, rotations, hands, lower, upper)
        distances[attempt] = distance
        if attempt >= STALLED_ROUNDS and distance > 0.95 * distances[attempt - STALLED_ROUNDS]:
            return False
        _step(joints, moving, jacobian, missing, lower, upper)
    return False


@compiled
def _look(rotations, places, hands, points, jacobian, missing):  # type: ignore[no-untyped-def]
    """Fill what is missing to the points, and how joints change it.

    Returns the farthest hand's distance and whether all point down.
    """
    farthest, is_down = 0.0, True
    tip, arm, axis = np.empty(3), np.empty(3), np.empty(3)
    for h in range(len(hands)):
        hand, row = hands[h], 6 * h
        distance = 0.0
        for i in range(3):
            tip[i] = places[hand, i] - GRIPPER_LENGTH_M * rotations[hand, i, 0]
            missing[row + i] = points[h, i] - tip[i]
            distance += missing[row + i] ** 2
        farthest = max(farthest, np.sqrt(distance))
        is_down = is_down and rotations[hand, 2, 0] > np.cos(MOST_TILT_RAD)
        weight = _TILT_WEIGHT_M
        if rotations[hand, 2, 0] > np.cos(FREE_TILT_RAD):
            weight *= _FREE_TILT_SHARE
        # The cross product of the fingers' direction with straight down.
        missing[row + 3] = weight * rotations[hand, 1, 0]
        missing[row + 4] = -weight * rotations[hand, 0, 0]
        for k in range(1 + _STEERING):
            joint = CHEST_JOINT if k == 0 else hand - _STEERING + k - 1
            column = 0 if k == 0 else _STEERING * h + k
            share = CHEST_SHARE if k == 0 else 1.0
            for i in range(3):
                axis[i] = share * rotations[joint, i, AXES[joint]]
                arm[i] = tip[i] - places[joint, i]
                jacobian[row + 3 + i, column] = weight * axis[i]
            for i in range(3):
                one, two = (i + 1) % 3, (i + 2) % 3
                jacobian[row + i, column] = axis[one] * arm[two] - axis[two] * arm[one]
    return farthest, is_down


@compiled
def _step(joints, moving, jacobian, missing, lower, upper):  # type: ignore[no-untyped-def]
    """One damped step; a joint at its limit that would go beyond is left out of it."""
    n = len(moving)
    held = np.zeros(n, np.bool_)
    step = np.zeros(n)
    for _ in range(3):
        _solve_normal_equations(jacobian, missing, held, step)
        is_final = True
        for i in range(n):
            angle = joints[moving[i]]
            at_upper = angle >= upper[moving[i]] and step[i] > 0.0
            at_lower = angle <= lower[moving[i]] and step[i] < 0.0
            if at_upper or at_lower:
                held[i] = True
                is_final = False
        if is_final:
            break
    largest = 1e-12
    step[0] *= CHEST_SHARE
    for i in range(n):
        largest = max(largest, abs(step[i]))
    portion = min(1.0, _LARGEST_STEP_RAD / largest)
    for i in range(n):
        if not held[i]:
            moved = joints[moving[i]] + portion * step[i]
            joints[moving[i]] = min(max(moved, lower[moving[i]]), upper[moving[i]])


@compiled
def _solve_normal_equations(jacobian, missing, held, step):  # type: ignore[no-untyped-def]
    """Write the damped least squares solution, 0 for what is held."""
    n_rows, n = jacobian.shape
    matrix = np.zeros((n, n))
    for i in range(n):
        step[i] = 0.0
        matrix[i, i] = _DAMPING**2
        if held[i]:
            continue
        for row in range(n_rows):
            step[i] += jacobian[row, i] * missing[row]
        for j in range(i + 1):
            if not held[j]:
                for row in range(n_rows):
                    matrix[i, j] += jacobian[row, i] * jacobian[row, j]
    _solve_by_cholesky(matrix, step)


@compiled
def _solve_by_cholesky(matrix, step):  # type: ignore[no-untyped-def]
    """Replace a right side f64[n] by the solution; the matrix by its decomposition."""
    n = len(step)
    for j in range(n):
        for k in range(j):
            matrix[j, j] -= matrix[j, k] ** 2
        matrix[j, j] = np.sqrt(matrix[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
            matrix[i, j] /= matrix[j, j]
    for i in range(n):
        for k in range(i):
            step[i] -= matrix[i, k] * step[k]
        step[i] /= matrix[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            step[i] -= matrix[k, i] * step[k]
        step[i] /= matrix[i, i]


@compiled
def _keep_headings(joints, rotations, hands, lower, upper):  # type: ignore[no-untyped-def]
    """Spin grippers so that their fingers open along the robot's y; whether limits allow it."""
    for h in range(len(hands)):
        hand = hands[h]
        angle = joints[hand] + np.arctan2(rotations[hand, 1, 2], rotations[hand, 1, 1])
        angle = np.arctan2(np.sin(angle), np.cos(angle))
        if not lower[hand] <= angle <= upper[hand]:
            return False
        joints[hand] = angle
    return True
