"""Plans the arms' motion for a gesture, and says why there is none: before anything moves.

The fingers point down, so that cloth that is folded over turns between them; a plan knows no turns
of the hand. Positions come from inverse kinematics, each point of the way starting from the one
before; the chest turns along. The way is tried with the chest begun in several directions, and with
either arm. What is checked is the whole way on which the joints really go, between its points too.
"""

from enum import StrEnum
from itertools import pairwise, product
from typing import Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from actors.cloth.gestures import Gesture
from actors.robot.clearance import dense, least_clearances_m
from actors.robot.inverse_kinematics import Solution, solve
from actors.robot.kinematics import fingertips_in_robot
from actors.robot.model import (
    ARMS,
    CHEST_JOINT,
    INITIAL_POSE_RAD,
    SPEED_RAD_PER_S,
    WITHDRAWN_POSE_RAD,
    Arm,
    arm_joints,
)
from actors.robot.motion import MotionPlan
from actors.robot.stances import Stance

STEP_M: Final = 0.02
"""Inverse kinematics is solved at least so often along the way."""

CHECK_RAD: Final = 0.05
"""Clearances are looked at whenever a joint has moved so far."""

ABOVE_M: Final = 0.08
"""Hands come down on the cloth, and leave it, from so far above."""

LEAST_CLEARANCE_M: Final = 0.01
"""Of links from each other, and of arms from the table."""

LEAST_HOVER_M: Final = 0.03
"""Grippers on their way to and from the cloth stay so far above the table."""

MOST_DETOUR_M: Final = 0.01
"""Fingers may be so far off the way between two points of it; more is a jump of the joints."""

HANDS_APART_M: Final = 0.045
"""Fingers are two rods of 3.2 cm."""

SHORTEST_SECS: Final = 0.001
"""Time between two rows of a plan, also where nothing moves."""

CHEST_BEGINS_RAD: Final = (0.0, 0.5, -0.5, 1.0, -1.0)
"""Where the search begins; the angles nearest to straight ahead come first."""


class Obstacle(StrEnum):
    """Why a gesture cannot be made."""

    OUT_OF_REACH = "out_of_reach"
    """No joint angles put the fingers there."""

    JOINT_LIMIT = "joint_limit"
    """Only angles beyond a joint's limits do, or a jump from one solution to another."""

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


class ArmPlanner:
    """Plans for a robot that stands somewhere; equal questions get equal plans."""

    def __init__(self, stance: Stance) -> None:
        """Prepare to plan.

        Args:
            stance: where the robot stands; the table is as large as its world.
        """
        self.stance = stance

    def plan(self, vertices_in_world: NDArray[np.float64], gesture: Gesture) -> MotionPlan:
        """The joints' way to cloth that lies so, through the gesture, and back.

        Args:
            vertices_in_world: f64[V, 3], metres; hands close where their first vertex is.
            gesture: what the hands do.

        Raises:
            UnreachableError: no arm for any hand, and no turn of the chest, does.
        """
        if len(gesture.hands) > len(ARMS):
            raise UnreachableError(
                Obstacle.TOO_MANY_HANDS, f"{len(gesture.hands)} hands for two arms"
            )
        starts = np.stack([vertices_in_world[hand.grasped[0]] for hand in gesture.hands])
        way, closes_at, opens_at = _way(starts, gesture)
        _check_apart(way)
        points = self.stance.in_robot(way[..., :3])
        refusal: UnreachableError | None = None
        for chest_rad, arms in product(CHEST_BEGINS_RAD, _assignments(points[0])):
            try:
                joints = self._joints(points, arms, chest_rad)
            except UnreachableError as error:
                refusal = refusal or error  # that of the natural way is the telling one
            else:
                turns = np.concatenate([way[:1, :, 3], way[..., 3], way[-1:, :, 3]])
                return MotionPlan(
                    joints, _times_secs(joints), turns, closes_at + 1, opens_at + 1, arms,
                    self.stance,
                )  # fmt: skip
        assert refusal is not None
        raise refusal

    def obstacle(self, vertices_in_world: NDArray[np.float64], gesture: Gesture) -> Obstacle | None:
        """Why there is no such plan; None where there is one."""
        try:
            self.plan(vertices_in_world, gesture)
        except UnreachableError as error:
            return error.obstacle
        return None

    def _joints(
        self, points: NDArray[np.float64], arms: tuple[Arm, ...], chest_rad: float
    ) -> NDArray[np.float64]:
        """f64[K + 2, 15] for points f64[K, H, 3], from withdrawn to withdrawn."""
        joints = np.array(WITHDRAWN_POSE_RAD)
        joints[CHEST_JOINT] = chest_rad
        for arm in arms:
            joints[arm_joints(arm)] = np.array(INITIAL_POSE_RAD)[arm_joints(arm)]
        rows = [np.array(WITHDRAWN_POSE_RAD)]
        for hands in points:
            solution = solve(joints, arms, hands)
            if solution is not Solution.FOUND:
                self._refuse(_OBSTACLES[solution], arms, hands)
            rows.append(joints.copy())
        way = np.stack([*rows, rows[0]])
        self._check_clearances(way, arms, points)
        self._check_hovers(way[[0, 1]], arms, points[0])
        self._check_hovers(way[[-2, -1]], arms, points[-1])
        self._check_detours(way[1:-1], arms, points)
        return way

    def _check_clearances(
        self, way: NDArray[np.float64], arms: tuple[Arm, ...], points: NDArray[np.float64]
    ) -> None:
        table_m = -self.stance.z_m
        own_m, above_table_m = least_clearances_m(dense(way, CHECK_RAD), table_m)
        if min(own_m, above_table_m) >= LEAST_CLEARANCE_M:
            return
        what = Obstacle.SELF_COLLISION if own_m < LEAST_CLEARANCE_M else Obstacle.TABLE
        for index, leg in enumerate(pairwise(way)):
            if (
                min(least_clearances_m(dense(np.stack(leg), CHECK_RAD), table_m))
                < LEAST_CLEARANCE_M
            ):
                self._refuse(what, arms, points[min(index, len(points) - 1)])

    def _check_hovers(
        self, leg: NDArray[np.float64], arms: tuple[Arm, ...], hands: NDArray[np.float64]
    ) -> None:
        heights_m = [
            fingertips_in_robot(dense(leg, CHECK_RAD), arm)[:, 2] + self.stance.z_m for arm in ARMS
        ]
        if np.min(heights_m) < LEAST_HOVER_M:
            self._refuse(Obstacle.TABLE, arms, hands)

    def _check_detours(
        self, way: NDArray[np.float64], arms: tuple[Arm, ...], points: NDArray[np.float64]
    ) -> None:
        halfway = (way[1:] + way[:-1]) / 2
        for arm in arms:
            tips, between = fingertips_in_robot(way, arm), fingertips_in_robot(halfway, arm)
            detours_m = np.linalg.norm(between - (tips[1:] + tips[:-1]) / 2, axis=1)
            if detours_m.max() > MOST_DETOUR_M:
                self._refuse(Obstacle.JOINT_LIMIT, arms, points[int(detours_m.argmax())])

    def _refuse(
        self, obstacle: Obstacle, arms: tuple[Arm, ...], points: NDArray[np.float64]
    ) -> NoReturn:
        places = [
            f"the {arm} hand at ({', '.join(f'{metres:.3f}' for metres in place)}) m"
            for arm, place in zip(arms, self.stance.in_world(points).tolist(), strict=True)
        ]
        raise UnreachableError(obstacle, " and ".join(places))


_OBSTACLES: Final = {
    Solution.BEYOND_LIMITS: Obstacle.JOINT_LIMIT,
    Solution.NONE: Obstacle.OUT_OF_REACH,
}


def _way(
    starts_in_world: NDArray[np.float64], gesture: Gesture
) -> tuple[NDArray[np.float64], int, int]:
    """Points and turns f64[K, H, 4] from above the cloth to above it; where hands close, open."""
    above = np.array([0.0, 0.0, ABOVE_M, 0.0])
    starts = np.concatenate([starts_in_world, np.zeros((len(starts_in_world), 1))], axis=1)
    stations = [hand.stations_and_turns() for hand in gesture.hands]
    corners = [starts + above, starts, *(np.stack(row) for row in zip(*stations, strict=True))]
    corners.append(corners[-1] + above)
    rows, ends = [corners[0][None]], [0]
    for a, b in pairwise(corners):
        longest_m = np.linalg.norm((b - a)[:, :3], axis=1).max()
        n_steps = max(1, int(np.ceil(longest_m / STEP_M)))
        portion = np.arange(1, n_steps + 1) / n_steps
        rows.append(a + portion[:, None, None] * (b - a))
        ends.append(ends[-1] + n_steps)
    return np.concatenate(rows), ends[1], ends[-2]


def _check_apart(way: NDArray[np.float64]) -> None:
    if way.shape[1] < 2:
        return
    nearest_m = float(np.linalg.norm((way[:, 0] - way[:, 1])[:, :3], axis=1).min())
    if nearest_m < HANDS_APART_M:
        raise UnreachableError(Obstacle.HANDS_TOO_CLOSE, f"hands {nearest_m:.3f} m apart")


def _assignments(starts_in_robot: NDArray[np.float64]) -> list[tuple[Arm, ...]]:
    """Arms for hands, the natural one first: the left arm for what lies more to its left."""
    lefts_m = starts_in_robot[:, 1]
    if len(lefts_m) == 1:
        return [("left",), ("right",)] if lefts_m[0] > 0 else [("right",), ("left",)]
    both: list[tuple[Arm, ...]] = [("left", "right"), ("right", "left")]
    return both if lefts_m[0] > lefts_m[1] else both[::-1]


def _times_secs(way: NDArray[np.float64]) -> NDArray[np.float64]:
    """When each row is reached if the fastest joint of each step moves at its limit."""
    steps = np.maximum(np.abs(np.diff(way, axis=0)).max(axis=1) / SPEED_RAD_PER_S, SHORTEST_SECS)
    return np.concatenate([[0.0], np.cumsum(steps)])
