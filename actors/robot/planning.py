"""Plans the arms' motion for a gesture, and says why there is none: before anything moves.

The fingers point down, so that cloth that is folded over turns between them; a plan knows no turns
of the hand. Positions come from inverse kinematics by damped least squares, each point of the way
starting from the one before.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.cloth.gestures import Gesture
from actors.robot.body import RobotBody
from actors.robot.model import ARMS, INITIAL_POSE_RAD, JOINTS, SPEED_RAD_PER_S, Arm, arm_joints

POSITION_TOLERANCE_M: Final = 0.002
MOST_TILT_RAD: Final = 0.35
"""The fingers may point so far away from straight down."""

STEP_M: Final = 0.02
"""Inverse kinematics is solved at least so often along the way."""

ABOVE_M: Final = 0.08
"""Hands come down on the cloth, and leave it, from so far above."""

LEAST_CLEARANCE_M: Final = 0.005
HANDS_APART_M: Final = 0.045
"""Fingers are two cylinders of 3.2 cm."""

MOST_ROUNDS: Final = 80
STALLED_ROUNDS: Final = 12
"""A hand that comes no nearer in so many rounds will not arrive."""
_DAMPING = 0.03
_TILT_WEIGHT_M = 0.15
_LARGEST_STEP_RAD = 0.25
_DOWN = np.array([0.0, 0.0, -1.0])
_LOWER = np.array([joint.lower_rad for joint in JOINTS])
_UPPER = np.array([joint.upper_rad for joint in JOINTS])


class Obstacle(StrEnum):
    """Why a gesture cannot be made."""

    OUT_OF_REACH = "out_of_reach"
    """No joint angles put the fingers there."""

    JOINT_LIMIT = "joint_limit"
    """Only angles beyond a joint's limits do."""

    SELF_COLLISION = "self_collision"
    """An arm would touch the body or the other arm."""

    TABLE = "table"
    """An arm would touch the table."""

    HANDS_TOO_CLOSE = "hands_too_close"
    """Two hands would be at nearly the same place."""

    TOO_MANY_HANDS = "too_many_hands"
    """There are two arms."""


class UnreachableError(Exception):
    """A gesture that the robot cannot make.

    Attributes:
        obstacle: Why.
    """

    def __init__(self, obstacle: Obstacle, what: str) -> None:
        """Says why, and where."""
        super().__init__(f"gesture: expected one that the robot can make; got {what} ({obstacle})")
        self.obstacle = obstacle


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """The joints' way for a gesture."""

    joints_rad: NDArray[np.float64]
    """f64[K, 15], in the order of `model.JOINTS`."""

    times_secs: NDArray[np.float64]
    """f64[K], from 0 on; no joint is faster than it may be."""

    closes_at: int
    """The row in which the grippers close."""

    opens_at: int
    """The row in which they open."""

    arms: tuple[Arm, ...]
    """Which arm is which hand of the gesture."""


class ArmPlanner:
    """Plans for one robot; it moves the body that it is given while it thinks."""

    def __init__(self, body: RobotBody, table_id: int | None = None) -> None:
        """Prepare to plan.

        Args:
            body: of the robot, in a physics client of the planner's own.
            table_id: PyBullet's of the table there, or None to let arms pass through it.
        """
        self._body = body
        self._table_id = table_id

    def plan(
        self, starts_in_world: NDArray[np.float64], gesture: Gesture, step_m: float = STEP_M
    ) -> MotionPlan:
        """The joints' way from the initial pose to the cloth, through the gesture, and up again.

        Args:
            starts_in_world: f64[H, 3], where each hand closes, metres.
            gesture: what the hands do; its turns are passed over.
            step_m: longest way between two solutions; infinite looks at the stations alone, which
                is quicker and may overlook something between them.

        Raises:
            UnreachableError: neither assignment of arms to hands does.
        """
        n_hands = len(gesture.hands)
        if n_hands > len(ARMS):
            raise UnreachableError(Obstacle.TOO_MANY_HANDS, f"{n_hands} hands for two arms")
        points, closes_at, opens_at = _way(starts_in_world, gesture, step_m)
        _check_apart(points)
        refusal: UnreachableError | None = None
        for arms in _assignments(starts_in_world):
            try:
                joints = self._joints(points, arms)
            except UnreachableError as error:
                refusal = refusal or error  # the natural assignment's reason is the telling one
            else:
                return MotionPlan(joints, _times_secs(joints), closes_at + 1, opens_at + 1, arms)
        assert refusal is not None
        raise refusal

    def reaches(self, point_in_world: Sequence[float]) -> Obstacle | None:
        """Why no arm can hold its fingers at a point, metres; None where one can."""
        points = np.array(point_in_world, dtype=np.float64)[None, None]
        refusal: Obstacle | None = None
        for arms in _assignments(points[0]):
            try:
                self._joints(points, arms)
            except UnreachableError as error:
                refusal = refusal or error.obstacle
            else:
                return None
        return refusal

    def _joints(self, points: NDArray[np.float64], arms: tuple[Arm, ...]) -> NDArray[np.float64]:
        """f64[K + 1, 15] for points f64[K, H, 3], from the initial pose on."""
        rows = [np.array(INITIAL_POSE_RAD)]
        self._body.pose(rows[0])
        for hands in points:
            for arm, point in zip(arms, hands, strict=True):
                self._solve(arm, point)
            rows.append(self._body.joints_rad.copy())
        return np.stack(rows)

    def _solve(self, arm: Arm, point: NDArray[np.float64]) -> None:
        """Pose the arm so that its fingers are at a point, point down, and touch nothing.

        Position and direction leave the arm no choice but how its hand is spun, so that there is
        no other solution to look for.
        """
        obstacle: Obstacle | None
        if self._converges(arm, point, within_limits=True):
            obstacle = self._touches(arm)
        elif self._converges(arm, point, within_limits=False):
            obstacle = Obstacle.JOINT_LIMIT
        else:
            obstacle = Obstacle.OUT_OF_REACH
        if obstacle is not None:
            place = ", ".join(f"{metres:.3f}" for metres in point)
            raise UnreachableError(obstacle, f"the {arm} hand at ({place}) m")

    def _touches(self, arm: Arm) -> Obstacle | None:
        if self._body.self_distance_m(arm) < LEAST_CLEARANCE_M:
            return Obstacle.SELF_COLLISION
        if self._table_id is None:
            return None
        is_near = self._body.distance_m(self._table_id, arm) < LEAST_CLEARANCE_M
        return Obstacle.TABLE if is_near else None

    def _converges(self, arm: Arm, point: NDArray[np.float64], *, within_limits: bool) -> bool:
        body, own = self._body, arm_joints(arm)
        begin, joints = body.joints_rad.copy(), body.joints_rad.copy()
        errors_m: list[float] = []
        for _ in range(MOST_ROUNDS):
            fingers = body.fingers(arm)
            error_m = point - fingers.position_in_world
            tilt = np.cross(fingers.direction_in_world, _DOWN)
            is_down = fingers.direction_in_world @ _DOWN > np.cos(MOST_TILT_RAD)
            if np.linalg.norm(error_m) < POSITION_TOLERANCE_M and is_down:
                return True
            errors_m.append(float(np.linalg.norm(error_m)))
            if len(errors_m) > STALLED_ROUNDS and errors_m[-1] > 0.95 * errors_m[-STALLED_ROUNDS]:
                break
            wanted = np.concatenate([error_m, _TILT_WEIGHT_M * tilt])
            jacobian = fingers.jacobian * np.array([1.0] * 3 + [_TILT_WEIGHT_M] * 3)[:, None]
            damped = jacobian @ jacobian.T + _DAMPING**2 * np.eye(6)
            step = jacobian.T @ np.linalg.solve(damped, wanted)
            step *= min(1.0, _LARGEST_STEP_RAD / (np.abs(step).max() + 1e-12))
            joints[own] += step
            if within_limits:
                joints[own] = np.clip(joints[own], _LOWER[own], _UPPER[own])
            body.pose(joints)
        body.pose(begin)
        return False


def _way(
    starts_in_world: NDArray[np.float64], gesture: Gesture, step_m: float
) -> tuple[NDArray[np.float64], int, int]:
    """Points f64[K, H, 3] from above the cloth to above it again; where hands close and open."""
    above = np.array([0.0, 0.0, ABOVE_M])
    stations = [hand.stations_in_world for hand in gesture.hands]
    corners = [starts_in_world + above, starts_in_world]
    corners += [np.stack(row) for row in zip(*stations, strict=True)]
    corners.append(corners[-1] + above)
    rows, ends = [corners[0][None]], [0]
    for a, b in pairwise(corners):
        n_steps = max(1, int(np.ceil(np.linalg.norm(b - a, axis=1).max() / step_m)))
        portion = np.arange(1, n_steps + 1) / n_steps
        rows.append(a + portion[:, None, None] * (b - a))
        ends.append(ends[-1] + n_steps)
    return np.concatenate(rows), ends[1], ends[-2]


def _check_apart(points: NDArray[np.float64]) -> None:
    if points.shape[1] < 2:
        return
    nearest_m = float(np.linalg.norm(points[:, 0] - points[:, 1], axis=1).min())
    if nearest_m < HANDS_APART_M:
        raise UnreachableError(Obstacle.HANDS_TOO_CLOSE, f"hands {nearest_m:.3f} m apart")


def _assignments(starts_in_world: NDArray[np.float64]) -> list[tuple[Arm, ...]]:
    """Arms for hands, the natural one first: the left arm for what lies more to the left."""
    x_m = starts_in_world[:, 0]
    if len(x_m) == 1:
        return [("left",), ("right",)] if x_m[0] < 0 else [("right",), ("left",)]
    return (
        [("left", "right"), ("right", "left")]
        if x_m[0] < x_m[1]
        else [
            ("right", "left"),
            ("left", "right"),
        ]
    )


def _times_secs(joints_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """When each row is reached if the fastest joint of each step moves at its limit."""
    steps = np.abs(np.diff(joints_rad, axis=0)).max(axis=1) / SPEED_RAD_PER_S
    return np.concatenate([[0.0], np.cumsum(steps)])
