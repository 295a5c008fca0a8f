"""Episodes that begin by spreading the cloth of the last one, without anybody's help.

With `automatic_reset=True` a cloth task lays its handkerchief once. Each later `reset` spreads what
lies there, green side up (`actors.cloth.spreading`), then disturbs it as its initial state asks
for. It lays the handkerchief anew, as a person would have to, where spreading gave up, where the
last step broke the cloth, and for the states `rotated` and `shifted`. Only then is the episode's
randomisation drawn anew. `info` of a reset then holds

* `reset_actions`: picks and drops that were spent, 0 where nothing was tried;
* `reset_end`: None where nothing was tried, else a value of `actors.cloth.spreading.SpreadEnd`;
* `reset_by_hand`: whether the handkerchief was laid anew.

Such an episode begins where the last one ended: it does not depend on its seed alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.gestures import Gesture, pick_and_drop
from actors.cloth.grasps import grasped_vertices
from actors.cloth.guard import GuardReason
from actors.cloth.masks import cloth_mask
from actors.cloth.pick_points import NoClothInViewError
from actors.cloth.spreading import OnPull, Spread, SpreadAim, TableLostError, spread
from actors.envs.initial_states import InitialState
from actors.envs.scene import Scene
from actors.robot.planning import Obstacle

PLACED: Final[tuple[InitialState, ...]] = ("rotated", "shifted")
"""States of a garment that was put somewhere, which spreading cannot do."""

AIM: Final = SpreadAim(up="green", actions=40)
"""The side on which a task lays its handkerchief."""

LEAST_PX: Final = 84
"""Of the picture that spreading looks at."""


@dataclass(frozen=True, eq=False)
class SceneTable:
    """A scene as the hand and eye of `actors.cloth.spreading`."""

    scene: Scene
    camera: Camera
    random: np.random.Generator
    """Draws the sensor's noise."""

    attempt: Callable[[Gesture], tuple[Obstacle | None, GuardReason | None]]
    """Makes a gesture in the scene; why the arms cannot, else why the cloth is not in order."""

    def look(self) -> NDArray[np.uint8]:
        """The camera's picture, u8[size, size, 3]."""
        scene = self.scene
        return scene.look.picture(
            scene.vertices_in_world(), scene.garment, self.random, self.camera
        )

    def pick_and_drop(self, pick_xy_m: tuple[float, float], drop_xy_m: tuple[float, float]) -> bool:
        """Make the gesture, if the arms can; see `HandAndEye.pick_and_drop`."""
        vertices = self.scene.vertices_in_world()
        gesture = pick_and_drop(vertices, grasped_vertices(vertices, pick_xy_m), drop_xy_m)
        obstacle, reason = self.attempt(gesture)
        if obstacle is not None:
            return False
        if reason is GuardReason.OUT_OF_VIEW:
            raise NoClothInViewError("scene: expected cloth in the picture; got none; lay it anew")
        if reason is not None:
            raise TableLostError(f"scene: expected a sound cloth; got {reason}; lay it anew")
        return True


def spread_scene(
    table: SceneTable, aim: SpreadAim | None = None, on_pull: OnPull | None = None
) -> Spread:
    """Spread the garment of a scene, whose flat area is drawn for the table's camera."""
    scene = table.scene
    flat = scene.look.picture(scene.garment.mesh.vertices_m, scene.garment, camera=table.camera)
    return spread(table, table.camera, int(cloth_mask(flat).sum()), table.random, aim, on_pull)


def spreading_camera(camera: Camera, size_px: int | None) -> Camera:
    """The observation's camera with larger pictures, where those asked for are larger."""
    return replace(camera, size_px=max(LEAST_PX, camera.size_px) if size_px is None else size_px)


def reset_info(outcome: Spread | None, by_hand: bool) -> dict[str, Any]:
    """What `info` says of how an episode began."""
    return {
        "reset_actions": 0 if outcome is None else outcome.actions,
        "reset_end": None if outcome is None else outcome.end.value,
        "reset_by_hand": by_hand,
    }


def check_automatic_reset(kind: str) -> None:
    """Check that a garment can be spread.

    Raises:
        ValueError: it is no handkerchief.
    """
    if kind != "handkerchief":
        raise ValueError(
            f"automatic_reset: expected a task with a handkerchief; got one with a {kind}; its "
            "rule is made for a square with two colours"
        )
