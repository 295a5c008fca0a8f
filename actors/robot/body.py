"""The robot in a PyBullet world: posed joint by joint, never simulated."""

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from actors.cloth.quiet_pybullet import pybullet
from actors.robot.model import FINGERS, JOINT_NAMES, WITHDRAWN_POSE_RAD, Arm, urdf
from actors.robot.stances import Stance


class RobotBody:
    """One robot in a physics client."""

    def __init__(self, client: int, stance: Stance, *, solid: bool = True) -> None:
        """Load it, its arms withdrawn.

        Args:
            client: PyBullet's, which the caller closes.
            stance: where it stands.
            solid: whether it touches what it meets; else it is only seen.
        """
        self._client = client
        with tempfile.TemporaryDirectory(prefix="clothbus-") as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(urdf(solid=solid), encoding="ascii")
            self.body_id = int(
                pybullet.loadURDF(
                    str(path),
                    stance.origin_in_world.tolist(),
                    pybullet.getQuaternionFromEuler([0.0, 0.0, stance.heading_rad]),
                    useFixedBase=True,
                    flags=pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_MAINTAIN_LINK_ORDER,
                    physicsClientId=client,
                )
            )
        infos = [
            pybullet.getJointInfo(self.body_id, index, physicsClientId=client)
            for index in range(pybullet.getNumJoints(self.body_id, physicsClientId=client))
        ]
        by_name = {info[1].decode(): info[0] for info in infos}
        self.links = [by_name[name] for name in JOINT_NAMES]
        """PyBullet's index of the link that each joint moves."""
        self._finger_links = {arm: by_name[f"{FINGERS[arm]}_JOINT"] for arm in FINGERS}
        self.pose(np.array(WITHDRAWN_POSE_RAD))

    def pose(self, joints_rad: NDArray[np.float64]) -> None:
        """Put every joint to an angle, f64[15], in the order of `model.JOINTS`."""
        pybullet.resetJointStatesMultiDof(
            self.body_id,
            self.links,
            [[angle] for angle in joints_rad.tolist()],
            physicsClientId=self._client,
        )

    def fingers_in_world(self, arm: Arm) -> NDArray[np.float64]:
        """Where an arm's fingers are as it is posed, f64[3], metres."""
        state = pybullet.getLinkState(
            self.body_id,
            self._finger_links[arm],
            computeForwardKinematics=1,
            physicsClientId=self._client,
        )
        return np.array(state[4])
