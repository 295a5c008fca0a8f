"""Which vertices of a cloth a gripper takes hold of."""

import numpy as np
from numpy.typing import NDArray

GRASP_RADIUS_M = 0.02  # about a fingertip; less than one cell of a 12 x 12 sheet of 0.3 m
TOP_LAYER_DEPTH_M = 0.012  # a few layers of 3 mm: what two fingers pinch from above
MOST_GRASPED = 4


def grasped_vertices(
    vertices_in_world: NDArray[np.float64], pick_xy_m: tuple[float, float]
) -> NDArray[np.int64]:
    """Vertices that a gripper closing from above takes, nearest first: at most 4 of the top layer.

    Where none is within the gripper's radius the circle grows until it holds one.

    Args:
        vertices_in_world: f64[V, 3], metres.
        pick_xy_m: the point of the table.

    Returns:
        i64[k], 1 <= k <= 4, vertex ids.
    """
    distance_m = _distances_m(vertices_in_world, pick_xy_m)
    # Half a radius beyond the nearest, so that a covered vertex does not hide the layer above it.
    reach_m = max(GRASP_RADIUS_M, float(distance_m.min()) + GRASP_RADIUS_M / 2)
    near = np.flatnonzero(distance_m <= reach_m)
    height_m = vertices_in_world[near, 2]
    top = near[height_m > height_m.max() - TOP_LAYER_DEPTH_M]
    nearest_first = top[np.argsort(distance_m[top], kind="stable")]
    return np.asarray(nearest_first[:MOST_GRASPED])


def pinched_vertices(
    vertices_in_world: NDArray[np.float64], pick_xy_m: tuple[float, float]
) -> NDArray[np.int64]:
    """Vertices that a gripper closing around the cloth's edge takes, nearest first: all layers.

    Where none is within the gripper's radius it takes the nearest.

    Args:
        vertices_in_world: f64[V, 3], metres.
        pick_xy_m: the point of the table.

    Returns:
        i64[k], k >= 1, vertex ids.
    """
    distance_m = _distances_m(vertices_in_world, pick_xy_m)
    near = np.flatnonzero(distance_m <= max(GRASP_RADIUS_M, float(distance_m.min())))
    return np.asarray(near[np.argsort(distance_m[near], kind="stable")])


def check_grasp(grasped: NDArray[np.int64], n_vertices: int) -> None:
    """Check vertex ids given to an engine.

    Raises:
        ValueError: there are none, a repeated one, or one that the cloth lacks.
    """
    ids = np.asarray(grasped)
    if ids.ndim != 1 or len(ids) == 0 or len(set(ids.tolist())) != len(ids):
        raise ValueError(
            f"grasped vertices: expected different ids, at least one; got {ids.tolist()}; "
            "choose them with grasped_vertices, and no vertex for two hands"
        )
    if ids.min() < 0 or ids.max() >= n_vertices:
        raise ValueError(
            f"grasped vertices: expected ids from 0 to {n_vertices - 1}; got {ids.tolist()}; "
            "choose them with grasped_vertices on this engine's vertices"
        )


def _distances_m(
    vertices_in_world: NDArray[np.float64], xy_m: tuple[float, float]
) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(vertices_in_world[:, :2] - np.asarray(xy_m), axis=1))
