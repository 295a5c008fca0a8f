"""What an action of a cloth task means for the cloth as it lies."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.gestures import Gesture, pick_and_drop
from actors.cloth.grasps import grasped_vertices


@dataclass(frozen=True)
class PlannedAction:
    """What an action means for the cloth as it lies now."""

    gesture: Gesture
    info: dict[str, Any] = field(default_factory=dict)
    """Where hands pick and drop, for `info`: pixels and metres."""


def planned_pick_and_drop(
    vertices_in_world: NDArray[np.float64],
    camera: Camera,
    pick_px: NDArray[np.int64],
    drop_xy_m: tuple[float, float],
) -> PlannedAction:
    """Pick cloth that lies so, f64[V, 3], up at a pixel i64[2] (column, row) and drop it."""
    column, row = pick_px.tolist()
    pick_xy_m = camera.table_point_m((column + 0.5, row + 0.5))
    grasped = grasped_vertices(vertices_in_world, pick_xy_m)
    return PlannedAction(
        pick_and_drop(vertices_in_world, grasped, drop_xy_m),
        {"pick_px": (column, row), "drop_xy_m": drop_xy_m},
    )
