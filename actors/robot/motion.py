"""How the joints move for a gesture, and what the fingers do meanwhile."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.cloth.carried import CarriedPaths, interpolated
from actors.cloth.gestures import Gesture
from actors.robot.kinematics import fingertips_in_robot
from actors.robot.model import JOINT_NAMES, Arm
from actors.robot.stances import Stance

SAMPLE_SECS = 0.01
"""How often a carried path says where the fingers are: they move 3 mm meanwhile."""


class JointPath(NamedTuple):
    """How joints move, for people: straight lines between postures."""

    names: tuple[str, ...]
    """Of J joints."""

    times_secs: NDArray[np.float64]
    """f64[K], from 0 on, by the robot's own clock."""

    joints_rad: NDArray[np.float64]
    """f64[K, J]"""


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """The joints' way for a gesture, from the arms withdrawn until they are withdrawn again."""

    joints_rad: NDArray[np.float64]
    """f64[K, 15], in the order of `model.JOINTS`; straight lines between the rows."""

    times_secs: NDArray[np.float64]
    """f64[K], from 0 on; no joint is faster than it may be."""

    turns_rad: NDArray[np.float64]
    """f64[K, H], how far each hand has turned the cloth between its fingers."""

    closes_at: int
    """The row in which the grippers close."""

    opens_at: int
    """The row in which they open."""

    arms: tuple[Arm, ...]
    """Which arm is which hand of the gesture."""

    stance: Stance
    """Where the robot stands."""

    @property
    def closes_secs(self) -> float:
        """When the grippers close."""
        return float(self.times_secs[self.closes_at])

    @property
    def opens_secs(self) -> float:
        """When they open."""
        return float(self.times_secs[self.opens_at])

    @property
    def joint_path(self) -> JointPath:
        """All of it by joint."""
        return JointPath(JOINT_NAMES, self.times_secs, self.joints_rad)

    def joints_at(self, times_secs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Joint angles f64[N, 15] at times f64[N]."""
        return interpolated(times_secs, self.times_secs, self.joints_rad)

    def fingers_in_world(self, times_secs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where the fingers of each hand are at times f64[N]: f64[N, H, 3], metres."""
        joints = self.joints_at(times_secs)
        tips = [fingertips_in_robot(joints, arm) for arm in self.arms]
        return self.stance.in_world(np.stack(tips, axis=1))

    def carried(self, gesture: Gesture) -> Gesture:
        """The gesture that was planned for, made as the robot really makes it."""
        duration_secs = self.opens_secs - self.closes_secs
        samples = np.linspace(0.0, duration_secs, int(np.ceil(duration_secs / SAMPLE_SECS)) + 1)
        rows = self.times_secs[self.closes_at : self.opens_at + 1]
        times = np.union1d(self.closes_secs + samples[1:-1], rows)
        paths = CarriedPaths(
            times - times[0],
            self.fingers_in_world(times),
            interpolated(times, self.times_secs, self.turns_rad),
            self.joints_at(times),
            self.arms,
        )
        return replace(gesture, paths=paths)
