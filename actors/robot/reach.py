"""Whether the robot could do what a task wants: a planner with a physics world of its own."""

import numpy as np
from numpy.typing import NDArray

from actors.cloth.engine import TABLE_HALF_WIDTH_M
from actors.cloth.gestures import Gesture
from actors.cloth.quiet_pybullet import pybullet
from actors.robot.body import RobotBody
from actors.robot.planning import STEP_M, ArmPlanner, MotionPlan, Obstacle, UnreachableError

TABLE_BEGINS_M = -0.22
"""The table's edge is before the robot: it does not stand in it."""

TABLE_THICKNESS_M = 0.1


class Reach:
    """One robot at its table; nothing is simulated."""

    def __init__(self) -> None:
        """Put robot and table into a new physics world."""
        self._client: int | None = pybullet.connect(pybullet.DIRECT)
        depth_m = TABLE_HALF_WIDTH_M - TABLE_BEGINS_M
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX,
            halfExtents=[TABLE_HALF_WIDTH_M, depth_m / 2, TABLE_THICKNESS_M / 2],
            physicsClientId=self._client,
        )
        middle = [0.0, TABLE_BEGINS_M + depth_m / 2, -TABLE_THICKNESS_M / 2]
        table = pybullet.createMultiBody(0, shape, -1, middle, physicsClientId=self._client)
        self.body = RobotBody(self._client)
        self._planner = ArmPlanner(self.body, table)

    def plan(
        self, vertices_in_world: NDArray[np.float64], gesture: Gesture, step_m: float = STEP_M
    ) -> MotionPlan:
        """The joints' way for a gesture on cloth that lies so, f64[V, 3]; see `ArmPlanner.plan`.

        Raises:
            UnreachableError: the robot cannot make it.
        """
        starts = np.stack([vertices_in_world[hand.grasped[0]] for hand in gesture.hands])
        return self._planner.plan(starts, gesture, step_m)

    def obstacle(
        self, vertices_in_world: NDArray[np.float64], gesture: Gesture, step_m: float = STEP_M
    ) -> Obstacle | None:
        """Why there is no such plan; None where there is one."""
        try:
            self.plan(vertices_in_world, gesture, step_m)
        except UnreachableError as error:
            return error.obstacle
        return None

    def close(self) -> None:
        """Give the world back; may be called twice."""
        if self._client is not None:
            pybullet.disconnect(physicsClientId=self._client)
        self._client = None
