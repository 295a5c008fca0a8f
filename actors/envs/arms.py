"""The robot at a cloth task: it makes gestures, says what is in its way, and can be filmed."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from actors.cloth.engine import Film
from actors.cloth.gestures import Gesture
from actors.cloth.guard import GuardReason
from actors.envs.robot_film import RobotFilm
from actors.envs.scene import Scene
from actors.robot.motion import JointPath, MotionPlan
from actors.robot.planning import ArmPlanner, Obstacle, UnreachableError
from actors.robot.stances import Stance


class Arms:
    """Both arms of a robot that stands at the table."""

    def __init__(self, stance: Stance) -> None:
        """Let the robot stand there."""
        self.stance = stance
        self.obstacles: tuple[Obstacle | None, ...] = ()
        """Why each action cannot be done, as `look_ahead` last found."""

        self.motion: JointPath | None = None
        """How the joints moved for the last gesture; None if they did not."""

        self.film_every_secs: float | None = None
        """Set it to have each gesture filmed; see `pictures`."""

        self._planner = ArmPlanner(stance)
        self._film: RobotFilm | None = None

    def look_ahead(self, scene: Scene, gestures: Iterable[Gesture]) -> NDArray[np.int8]:
        """Which gestures can be made, i8[N], 1 for those; `obstacles` tells the reasons."""
        vertices = scene.vertices_in_world()
        self.obstacles = tuple(self._planner.obstacle(vertices, it) for it in gestures)
        return np.array([obstacle is None for obstacle in self.obstacles], dtype=np.int8)

    def attempt(
        self, scene: Scene, gesture: Gesture, *, is_missed: bool
    ) -> tuple[Obstacle | None, GuardReason | None]:
        """Make a gesture if it can be made.

        Args:
            scene: where the cloth lies.
            gesture: planned for it.
            is_missed: the grippers close on nothing.

        Returns:
            Why it cannot, else why the cloth is not in order afterwards.
        """
        self.draw_back()
        try:
            plan = self._planner.plan(scene.vertices_in_world(), gesture)
        except UnreachableError as error:
            return error.obstacle, None
        self.motion = plan.joint_path
        return None, self._made(scene, gesture, plan, is_missed)

    def pictures(self, scene: Scene, size_px: int) -> list[NDArray[np.uint8]]:
        """The last gesture, every `film_every_secs`: u8[size, size, 3] each.

        Empty where the robot did not move, was not filmed, or the guard stopped the step.
        """
        film = self._film
        if film is None:
            return []
        return [
            film.picture(time_secs, scene.garment, scene.look, size_px)
            for time_secs in film.times_secs().tolist()
        ]

    def draw_back(self) -> None:
        """Forget the last gesture: another one, or a new episode, begins."""
        self._film = self.motion = None

    def _made(
        self, scene: Scene, gesture: Gesture, plan: MotionPlan, is_missed: bool
    ) -> GuardReason | None:
        every_secs, before = self.film_every_secs, scene.vertices_in_world()
        film = None if every_secs is None else Film(every_secs)
        reason = None if is_missed else scene.perform(plan.carried(gesture), film)
        if film is not None and reason is None:
            self._film = RobotFilm(plan, before, film, scene.vertices_in_world())
        return reason
