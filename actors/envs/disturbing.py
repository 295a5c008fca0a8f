"""What is done to a spread garment so that an episode begins in another state."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.gestures import Gesture, pick_and_drop
from actors.cloth.grasps import grasped_vertices
from actors.cloth.guard import GuardReason
from actors.cloth.measures import normalised_coverage
from actors.envs.initial_states import InitialState
from actors.envs.scene import Scene

CREASES: Final = 2
CREASE_M: Final = (0.015, 0.03)
CRUMPLES: Final = (8, 30)
"""The least and the most picks and drops."""

CRUMPLED_BELOW: Final = 0.7
"""Normalised coverage at which it is enough."""

CRUMPLE_M: Final = 0.05


def disturb(
    scene: Scene, name: InitialState, creases: int, flat_px: int, random: np.random.Generator
) -> GuardReason | None:
    """Bring a spread garment into an initial state, as far as gestures of no task can.

    Args:
        scene: where it lies.
        name: of the state.
        creases: to make in any case, besides those of the state.
        flat_px: pixels that the spread garment covers.
        random: draws where.

    Returns:
        Why the cloth is not in order; None where it is.
    """
    makers = [crease] * (creases + (CREASES if name == "creased" else 0))
    makers += [fold_over] * (name == "folded_over")
    makers += [crumple] * (CRUMPLES[1] if name == "crumpled" else 0)
    for times, make in enumerate(makers):
        if make is crumple and _is_crumpled(times - creases, scene, flat_px):
            break
        gesture = make(scene.vertices_in_world(), scene.mask, scene.look.camera, random)
        if reason := scene.perform(gesture):
            return reason
    return None


def crease(
    vertices_in_world: NDArray[np.float64],
    mask: NDArray[np.bool_],
    camera: Camera,
    random: np.random.Generator,
) -> Gesture:
    """Pinch the cloth somewhere and set it down a few centimetres away, which leaves a crease."""
    pick_xy_m = _random_point_m(mask, camera, random)
    direction, length_m = random.uniform(-np.pi, np.pi), random.uniform(*CREASE_M)
    drop_xy_m = (
        pick_xy_m[0] + length_m * np.cos(direction),
        pick_xy_m[1] + length_m * np.sin(direction),
    )
    grasped = grasped_vertices(vertices_in_world, pick_xy_m)
    return pick_and_drop(vertices_in_world, grasped, drop_xy_m)


def crumple(
    vertices_in_world: NDArray[np.float64],
    mask: NDArray[np.bool_],
    camera: Camera,
    random: np.random.Generator,
) -> Gesture:
    """Pick the cloth up anywhere and drop it near the table's middle."""
    pick_xy_m = _random_point_m(mask, camera, random)
    x_m, y_m = random.uniform(-CRUMPLE_M, CRUMPLE_M, 2).tolist()
    return pick_and_drop(
        vertices_in_world, grasped_vertices(vertices_in_world, pick_xy_m), (x_m, y_m)
    )


def fold_over(
    vertices_in_world: NDArray[np.float64],
    mask: NDArray[np.bool_],
    camera: Camera,
    random: np.random.Generator,
) -> Gesture:
    """Carry the outermost point in some direction to the garment's middle."""
    rows, columns = np.nonzero(mask)
    points_m = camera.table_points_m(np.stack([columns, rows], axis=1) + 0.5)
    middle_m = points_m.mean(axis=0)
    direction = random.uniform(-np.pi, np.pi)
    outermost = (points_m @ np.array([np.cos(direction), np.sin(direction)])).argmax()
    x_m, y_m = points_m[outermost].tolist()
    grasped = grasped_vertices(vertices_in_world, (x_m, y_m))
    drop_xy_m = (float(middle_m[0]), float(middle_m[1]))
    return pick_and_drop(vertices_in_world, grasped, drop_xy_m)


def _random_point_m(
    mask: NDArray[np.bool_], camera: Camera, random: np.random.Generator
) -> tuple[float, float]:
    """Any point of the table that the garment covers in the picture, as (x, y)."""
    rows, columns = np.nonzero(mask)
    pixel = int(random.integers(len(rows)))
    return camera.table_point_m((columns[pixel] + 0.5, rows[pixel] + 0.5))


def _is_crumpled(times: int, scene: Scene, flat_px: int) -> bool:
    return times >= CRUMPLES[0] and normalised_coverage(scene.mask, flat_px) < CRUMPLED_BELOW
