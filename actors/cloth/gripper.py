"""How a gripper takes hold of cloth and where it carries it, whatever engine moves the cloth."""

from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

GRASP_RADIUS_M = 0.02  # about a fingertip; less than one cell of a 12 x 12 sheet of 0.3 m
TOP_LAYER_DEPTH_M = 0.012  # a few layers of 3 mm: what two fingers pinch from above
MOST_GRASPED = 4


@dataclass(frozen=True)
class GripperMotion:
    """The one gesture of these tasks: lift, carry, lower, let go, and wait for the cloth."""

    lift_height_m: float = 0.10
    """Height above the table at which the cloth is carried."""

    release_height_m: float = 0.03
    """Height above the table at which the gripper lets go."""

    speed_m_per_s: float = 1.0
    """Speed along each of the three straight lines."""

    settle_secs: float = 0.2
    """Simulated time after letting go."""

    def __post_init__(self) -> None:
        """Check each number.

        Raises:
            ValueError: a number is not positive.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 < value < np.inf:
                raise ValueError(
                    f"GripperMotion.{field.name}: expected a positive number; got {value}; "
                    f"the default is {field.default}"
                )


def gripper_path_in_world(
    start_in_world: NDArray[np.float64],
    drop_xy_m: tuple[float, float],
    motion: GripperMotion,
    time_step_secs: float,
) -> NDArray[np.float64]:
    """Gripper positions, one for each time step: up, across, down.

    Args:
        start_in_world: f64[3], where the gripper closed, metres.
        drop_xy_m: where on the table it opens.
        motion: heights and speed.
        time_step_secs: time between two positions.

    Returns:
        f64[K, 3], metres, without the start and with the end.
    """
    drop = np.asarray(drop_xy_m, dtype=np.float64)
    corners = [
        start_in_world,
        np.array([start_in_world[0], start_in_world[1], motion.lift_height_m]),
        np.array([drop[0], drop[1], motion.lift_height_m]),
        np.array([drop[0], drop[1], motion.release_height_m]),
    ]
    step_m = motion.speed_m_per_s * time_step_secs
    lines = [_line(a, b, step_m) for a, b in pairwise(corners)]
    return np.concatenate(lines)


def grasped_vertices(
    vertices_in_world: NDArray[np.float64], pick_xy_m: tuple[float, float]
) -> NDArray[np.int64]:
    """Vertices that a gripper closing at a point of the table takes, nearest first.

    Of the vertices around the point only those of the top layer are taken, as fingers from above
    would. Where none is within the gripper's radius the circle grows until it holds one.

    Args:
        vertices_in_world: f64[V, 3], metres.
        pick_xy_m: the point.

    Returns:
        i64[k], 1 <= k <= 4, vertex ids.
    """
    distance_m = np.linalg.norm(vertices_in_world[:, :2] - np.asarray(pick_xy_m), axis=1)
    # Half a radius beyond the nearest, so that a covered vertex does not hide the layer above it.
    reach_m = max(GRASP_RADIUS_M, float(distance_m.min()) + GRASP_RADIUS_M / 2)
    near = np.flatnonzero(distance_m <= reach_m)
    height_m = vertices_in_world[near, 2]
    top = near[height_m > height_m.max() - TOP_LAYER_DEPTH_M]
    nearest_first = top[np.argsort(distance_m[top], kind="stable")]
    return np.asarray(nearest_first[:MOST_GRASPED])


def check_drop(drop_xy_m: tuple[float, float]) -> None:
    """Check a drop point.

    Raises:
        ValueError: it is not two finite numbers.
    """
    if len(drop_xy_m) != 2 or not np.isfinite(drop_xy_m).all():
        raise ValueError(
            f"drop_xy_m: expected two finite numbers, metres; got {drop_xy_m}; "
            "give a point of the table"
        )


def check_grasp(grasped: NDArray[np.int64], n_vertices: int) -> None:
    """Check vertex ids given to an engine.

    Raises:
        ValueError: there are none, more than 4, a repeated one, or one that the cloth lacks.
    """
    ids = np.asarray(grasped)
    right_number = ids.ndim == 1 and 1 <= len(ids) <= MOST_GRASPED
    if not right_number or len(set(ids.tolist())) != len(ids):
        raise ValueError(
            f"grasped vertices: expected 1 to {MOST_GRASPED} different ids; got {ids.tolist()}; "
            "choose them with grasped_vertices"
        )
    if ids.min() < 0 or ids.max() >= n_vertices:
        raise ValueError(
            f"grasped vertices: expected ids from 0 to {n_vertices - 1}; got {ids.tolist()}; "
            "choose them with grasped_vertices on this engine's vertices"
        )


def _line(
    start: NDArray[np.float64], end: NDArray[np.float64], step_m: float
) -> NDArray[np.float64]:
    # Two points at least: a first step over the whole of a short line would jerk the cloth.
    n_points = max(2, int(np.ceil(np.linalg.norm(end - start) / step_m)))
    portion = np.arange(1, n_points + 1) / n_points
    points: NDArray[np.float64] = start + portion[:, None] * (end - start)
    return points
