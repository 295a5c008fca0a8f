"""How well cloth is spread or folded: the field's measures, from pictures or from vertices.

Coverage and IoU need masks alone, so that they serve a real camera as well. The mean particle
distance needs the simulator's vertices.
"""

from math import cos, sin

import cv2
import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.engine import TABLE_HALF_WIDTH_M
from actors.cloth.garments import Garment
from actors.cloth.masks import cloth_mask
from actors.cloth.rasteriser import draw_cloth

FAR_ABOVE = Camera(size_px=600, view_half_width_m=TABLE_HALF_WIDTH_M, height_m=20.0)
"""Sees the table from where heights do not matter; 2 mm to a pixel."""

TURN_STEPS = 72
"""Turns of a mask that are tried, and then four times finer ones around the best."""


def coverage_m2(mask: NDArray[np.bool_], px_per_m: float) -> float:
    """The area of table that cloth covers, square metres, for a mask bool[H, W]."""
    return float(mask.sum()) / px_per_m**2


def normalised_coverage(mask: NDArray[np.bool_], flat_px: int) -> float:
    """Coverage over that of the flat garment, both in pixels of the same camera.

    Raises:
        ValueError: the flat garment covers nothing.
    """
    if flat_px < 1:
        raise ValueError(
            f"flat_px: expected the pixels of the flat garment; got {flat_px}; draw it first"
        )
    return float(mask.sum()) / flat_px


def true_coverage(vertices_in_world: NDArray[np.float64], garment: Garment) -> float:
    """Normalised coverage of a simulator's vertices, f64[V, 3], as from far above.

    It sees the whole table, however little of it a task's camera shows.
    """
    faces = garment.mesh.faces
    flat = cloth_mask(draw_cloth(garment.mesh.vertices_m, faces, FAR_ABOVE))
    return normalised_coverage(
        cloth_mask(draw_cloth(vertices_in_world, faces, FAR_ABOVE)), int(flat.sum())
    )


def normalised_performance(value: float, at_start: float, at_best: float) -> float:
    """(p - p0) / (p* - p0): 0 as at the start, 1 as well as can be.

    Raises:
        ValueError: the best is the start.
    """
    if at_best == at_start:
        raise ValueError(
            f"normalised_performance: expected a best value apart from the start's; got {at_start} "
            "for both; such an episode measures nothing"
        )
    return (value - at_start) / (at_best - at_start)


def iou(mask: NDArray[np.bool_], target: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks bool[H, W]; 1 for two empty ones."""
    union = int((mask | target).sum())
    return float((mask & target).sum()) / union if union else 1.0


def aligned_iou(
    mask: NDArray[np.bool_], target: NDArray[np.bool_], *, may_mirror: bool = False
) -> float:
    """The best IoU over where a fold lies and how it is turned.

    The mask is moved so that its centroid is the target's, and turned in steps of 5 degrees, then
    of 1.25 degrees around the best.

    Args:
        mask: bool[H, W], what there is.
        target: bool[H, W], what there should be.
        may_mirror: also try its mirror image, for garments whose left and right are alike.
    """
    if not mask.any() or not target.any():
        return iou(mask, target)
    candidates = [mask, mask[:, ::-1]] if may_mirror else [mask]
    return max(_best_turn(candidate, target) for candidate in candidates)


def mean_particle_distance_m(
    vertices_in_world: NDArray[np.float64],
    target_in_world: NDArray[np.float64],
    garment: Garment,
) -> float:
    """Mean distance of vertices from their places in a target, wherever that lies.

    The least over all movements and turns along the table and over the garment's symmetries; a
    symmetry that swaps left and right is compared with the mirrored target, since folding the left
    side first or the right one is equally good.

    Args:
        vertices_in_world: f64[V, 3], metres.
        target_in_world: f64[V, 3], metres.
        garment: whose vertices these are.
    """
    distances = []
    for symmetry in garment.symmetries:
        named = vertices_in_world[symmetry.order]
        target = target_in_world * [-1.0, 1.0, 1.0] if symmetry.mirrored else target_in_world
        aligned = _aligned(named, target)
        distances.append(float(np.linalg.norm(aligned - target, axis=1).mean()))
    return min(distances)


def _aligned(points: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points moved and turned along the table for the least squared distance to their targets."""
    centre, target_centre = points[:, :2].mean(axis=0), target[:, :2].mean(axis=0)
    here, there = points[:, :2] - centre, target[:, :2] - target_centre
    along = (here * there).sum()
    across = (here[:, 0] * there[:, 1] - here[:, 1] * there[:, 0]).sum()
    angle = np.arctan2(across, along)
    turn = np.array([[cos(angle), sin(angle)], [-sin(angle), cos(angle)]])
    aligned = points.copy()
    aligned[:, :2] = here @ turn + target_centre
    return aligned


def _best_turn(mask: NDArray[np.bool_], target: NDArray[np.bool_]) -> float:
    step_deg = 360 / TURN_STEPS
    centroids = _centroid(mask), _centroid(target)
    # OpenCV counts pixels several times faster than NumPy, and this is done at every step.
    pixels, goal = mask.astype(np.uint8) * 255, target.astype(np.uint8) * 255
    coarse = {turn * step_deg: 0.0 for turn in range(TURN_STEPS)}
    for turn_deg in coarse:
        coarse[turn_deg] = _turned_iou(pixels, goal, centroids, turn_deg)
    best_deg = max(coarse, key=lambda turn_deg: coarse[turn_deg])
    fine = [best_deg + quarter * step_deg / 4 for quarter in (-3, -2, -1, 1, 2, 3)]
    return max(coarse[best_deg], *(_turned_iou(pixels, goal, centroids, turn) for turn in fine))


def _turned_iou(
    pixels: NDArray[np.uint8],
    goal: NDArray[np.uint8],
    centroids: tuple[tuple[float, float], tuple[float, float]],
    turn_deg: float,
) -> float:
    """The IoU with a mask turned about its centroid, which is moved onto the other one.

    Masks are u8[H, W], 0 or 255.
    """
    (x, y), (goal_x, goal_y) = centroids
    matrix = cv2.getRotationMatrix2D((x, y), turn_deg, 1.0)
    matrix[0, 2] += goal_x - x
    matrix[1, 2] += goal_y - y
    moved = cv2.warpAffine(pixels, matrix, goal.shape[::-1], flags=cv2.INTER_LINEAR)
    _, moved = cv2.threshold(moved, 127, 255, cv2.THRESH_BINARY)
    common_px = cv2.countNonZero(cv2.bitwise_and(moved, goal))
    return common_px / (cv2.countNonZero(moved) + cv2.countNonZero(goal) - common_px)


def _centroid(mask: NDArray[np.bool_]) -> tuple[float, float]:
    rows, columns = np.nonzero(mask)
    return float(columns.mean()), float(rows.mean())
