"""What the robot's arms and the cloth do in a step, as pictures for people."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from actors.cloth.engine import Film
from actors.cloth.garments import Garment
from actors.cloth.rasteriser import Paint
from actors.envs.scene import Look
from actors.robot.motion import MotionPlan
from actors.robot.pictures import Figure, draw_together, onlooker, robot_figure


@dataclass(frozen=True, eq=False)
class RobotFilm:
    """A step of the robot: its plan, and where the cloth was."""

    plan: MotionPlan
    before: NDArray[np.float64]
    """f64[V, 3], until the grippers close."""

    carried: Film
    """From closing to opening; empty if they closed on nothing."""

    after: NDArray[np.float64]
    """f64[V, 3], once the cloth had come to rest: shown from opening on."""

    def times_secs(self) -> NDArray[np.float64]:
        """When pictures are taken, f64[N]: also just when the film's frames were."""
        every_secs = self.carried.every_secs
        return np.arange(self.plan.closes_secs % every_secs, self.plan.times_secs[-1], every_secs)

    def vertices_at(self, time_secs: float) -> NDArray[np.float64]:
        """Where the cloth is at a time of the plan, f64[V, 3]."""
        if time_secs >= self.plan.opens_secs:
            return self.after
        since_secs = time_secs - self.plan.closes_secs
        if since_secs < -1e-9 or not self.carried.frames:
            return self.before
        frame = round(since_secs / self.carried.every_secs)
        return self.carried.frames[min(frame, len(self.carried.frames) - 1)]

    def picture(
        self, time_secs: float, garment: Garment, look: Look, size_px: int
    ) -> NDArray[np.uint8]:
        """Robot and cloth at a time of the plan, from before the robot, u8[size, size, 3]."""
        stance = self.plan.stance
        (joints,) = self.plan.joints_at(np.array([time_secs]))
        return draw_together(
            Figure(self.vertices_at(time_secs), garment.mesh.faces, _paint(garment, look)),
            robot_figure(joints, stance),
            onlooker(stance, size_px),
            look.colours,
            look.light,
        )


def _paint(garment: Garment, look: Look) -> Paint:
    if look.paint is not None:
        return look.paint
    n_faces = len(garment.mesh.faces)
    front, back = (
        np.tile(np.array(side, dtype=np.uint8), (n_faces, 1))
        for side in (look.colours.front, look.colours.back)
    )
    return Paint(front, back)
