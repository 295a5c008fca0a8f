"""The robot in a PyBullet world: posed joint by joint, never simulated."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.cloth.quiet_pybullet import pybullet
from actors.robot.model import FINGERS, INITIAL_POSE_RAD, JOINT_NAMES, JOINTS, Arm, arm_joints, urdf

STANDS_AT_M: Final = (0.0, -0.31, 0.08)
"""The waist in the table's world: the robot stands at the picture's lower side and looks up it."""

_TURNED = (0.0, 0.0, float(np.sin(np.pi / 4)), float(np.cos(np.pi / 4)))  # its x is the world's y
_TO_WORLD: Final = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_NEIGHBOURS: Final = 2
"""Links so many joints apart always overlap a little, as the primitives are thick."""


@dataclass(frozen=True, eq=False)
class Fingers:
    """Where the tips of a gripper are."""

    position_in_world: NDArray[np.float64]
    """f64[3], metres."""

    direction_in_world: NDArray[np.float64]
    """f64[3], unit, out of the hand."""

    jacobian: NDArray[np.float64]
    """f64[6, 6]: velocity and angular velocity of the fingers by the arm's six joints."""


class RobotBody:
    """One robot in a physics client."""

    def __init__(self, client: int) -> None:
        """Load it, in its initial pose.

        Args:
            client: PyBullet's, which the caller closes.
        """
        self._client = client
        with tempfile.TemporaryDirectory(prefix="clothbus-") as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(urdf(), encoding="ascii")
            self.body_id = int(
                pybullet.loadURDF(
                    str(path), STANDS_AT_M, _TURNED, useFixedBase=True, physicsClientId=client,
                    flags=pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_MAINTAIN_LINK_ORDER,
                )
            )  # fmt: skip
        infos = [
            pybullet.getJointInfo(self.body_id, index, physicsClientId=client)
            for index in range(pybullet.getNumJoints(self.body_id, physicsClientId=client))
        ]
        by_name = {info[1].decode(): info[0] for info in infos}
        self._joint_indices = [by_name[name] for name in JOINT_NAMES]
        self._finger_links = {arm: by_name[f"{FINGERS[arm]}_JOINT"] for arm in FINGERS}
        self._parents = {info[0]: info[16] for info in infos}
        self.joints_rad = np.array(INITIAL_POSE_RAD)
        self.pose(self.joints_rad)

    def pose(self, joints_rad: NDArray[np.float64]) -> None:
        """Put every joint to an angle, f64[15], in the order of `model.JOINTS`."""
        self.joints_rad = joints_rad.copy()
        for index, angle in zip(self._joint_indices, joints_rad.tolist(), strict=True):
            pybullet.resetJointState(self.body_id, index, angle, physicsClientId=self._client)

    def fingers(self, arm: Arm) -> Fingers:
        """Where an arm's fingers are, and how they move with its joints."""
        link = self._finger_links[arm]
        state = pybullet.getLinkState(
            self.body_id, link, computeForwardKinematics=1, physicsClientId=self._client
        )
        rotation = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        angles = self.joints_rad.tolist()
        zeros = [0.0] * len(angles)
        linear, angular = pybullet.calculateJacobian(
            self.body_id, link, [0.0, 0.0, 0.0], angles, zeros, zeros, physicsClientId=self._client
        )
        columns = arm_joints(arm)
        # PyBullet gives it in the robot's own frame.
        jacobian = np.concatenate([_TO_WORLD @ linear, _TO_WORLD @ angular])[:, columns]
        return Fingers(np.array(state[4]), -rotation[:, 0], jacobian)

    def self_distance_m(self, arm: Arm) -> float:
        """The least distance of an arm's links from what is not next to them, at most 5 cm."""
        own = {self._joint_indices[j] for j in arm_joints(arm)}
        points = pybullet.getClosestPoints(
            self.body_id, self.body_id, 0.05, physicsClientId=self._client
        )
        apart = [
            point[8]
            for point in points
            if (point[3] in own or point[4] in own) and not self._are_near(point[3], point[4])
        ]
        return min(apart, default=0.05)

    def distance_m(self, body_id: int, arm: Arm) -> float:
        """The least distance of an arm's links, but its hand, from another body, at most 5 cm."""
        upper = [self._joint_indices[j] for j in arm_joints(arm)][:-1]
        points = pybullet.getClosestPoints(
            self.body_id, body_id, 0.05, physicsClientId=self._client
        )
        return min((point[8] for point in points if point[3] in upper), default=0.05)

    def _are_near(self, one: int, two: int) -> bool:
        """Whether they are one link, or at most `_NEIGHBOURS` joints lie between them."""
        if one == two:
            return True
        for start, goal in ((one, two), (two, one)):
            link = start
            for _ in range(_NEIGHBOURS):
                link = self._parents.get(link, -1)
                if link == goal:
                    return True
        return False


assert len(JOINTS) == len(INITIAL_POSE_RAD) == 15
