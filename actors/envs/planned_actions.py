"""What an action of a cloth task means for the cloth as it lies."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.fold_lines import FoldPlan, fold
from actors.cloth.gestures import Gesture, pick_and_drop
from actors.cloth.grasps import grasped_vertices
from broker_config.messages import Mark


@dataclass(frozen=True)
class PlannedAction:
    """What an action means for the cloth as it lies now."""

    gesture: Gesture
    info: dict[str, Any] = field(default_factory=dict)
    """Where hands pick and drop, for `info`: pixels and metres."""

    marks: tuple[Mark, ...] = ()
    """The same in the picture, for people."""


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
        (
            Mark("pick", ((column + 0.5, row + 0.5),)),
            Mark("drop", _seen_px(camera, (drop_xy_m,))),
        ),
    )


def planned_fold(
    vertices_in_world: NDArray[np.float64], camera: Camera, plan: FoldPlan
) -> PlannedAction:
    """Fold cloth that lies so, f64[V, 3], as planned for what the camera saw."""
    return PlannedAction(
        fold(vertices_in_world, plan),
        {"fold_line_m": plan.line_m, "grasps_m": plan.grasps_m, "drops_m": plan.drops_m},
        (
            Mark("fold_line", _seen_px(camera, plan.line_m)),
            *(Mark("pick", _seen_px(camera, (point_m,))) for point_m in plan.grasps_m),
            *(Mark("drop", _seen_px(camera, (point_m,))) for point_m in plan.drops_m),
        ),
    )


def _seen_px(
    camera: Camera, points_m: Sequence[tuple[float, float]]
) -> tuple[tuple[float, float], ...]:
    """Where the camera sees points of the table's top."""
    points_px = camera.project_px(np.pad(np.array(points_m), ((0, 0), (0, 1))))
    return tuple((x, y) for x, y in points_px.tolist())
