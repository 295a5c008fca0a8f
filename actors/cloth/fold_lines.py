"""Folding along one of six lines that follow from the garment's current outline.

Source: table 4.4a and figure 4.11: all fold lines are defined by the current shape (3 + 3), the
fold goes towards the centre, grasp points and path are computed. **assumed**: where the lines are
(through the middle, and on either side where sleeves begin, or else at a quarter of the shape's
length and width), that the two through the middle fold the left half over the right and the lower
half over the upper, how grasp points are chosen, and that hands move on half circles around the
line and turn what they hold upside down.
"""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.gestures import Gesture, GripperMotion, Hand
from actors.cloth.grasps import pinched_vertices

N_FOLD_LINES: Final = 6
_LINES: Final[tuple[tuple[int, float, int], ...]] = (
    (0, 0.25, 1),
    (0, 0.5, 1),
    (0, 0.75, -1),
    (1, 0.25, 1),
    (1, 0.5, 1),
    (1, 0.75, -1),
)
"""Axis that the line cuts (0 from left to right, 1 from below upwards), where it cuts it, as a
portion of the shape's extent, and in which direction along the axis cloth is folded."""

FOLD_STATIONS = 24
"""Straight pieces of a half circle."""
MOST_TURN_DEG = 42.0
COARSE_STEP_DEG = 3.0
FINE_STEP_DEG = 0.75
TRUNK_PORTION = 0.4
"""What is narrower than this portion of the thickest part is a sleeve."""
STICKS_OUT_M = 0.02
"""A line lies where sleeves begin, if they are at least this long."""
RIM_PX = 2
"""Hands grasp so far inside of the outline."""
LEAST_PORTION = 1 / 3
"""Hands grasp at least at this portion of the farthest point's distance from the line."""
HANDS_APART_M = 0.05
"""Two hands nearer than this would collide: then one of them folds alone."""
FOLD_MOTION: Final = GripperMotion(release_height_m=0.01, speed_m_per_s=0.5, settle_secs=0.3)
HIGHEST_M = 0.18
"""Half circles higher than this are flattened to it."""


@dataclass(frozen=True)
class GarmentFrame:
    """A garment's own axes on the table, found in its mask."""

    centroid_m: tuple[float, float]
    turn_rad: float
    """How far the garment is turned, counter-clockwise seen from above."""

    def coordinates_m(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points of the table f64[n, 2] along the garment's right and up, f64[n, 2]."""
        return np.asarray((points_m - self.centroid_m) @ self._axes().T)

    def on_table_m(self, coordinates_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `coordinates_m`."""
        return np.asarray(coordinates_m @ self._axes() + self.centroid_m)

    def _axes(self) -> NDArray[np.float64]:
        cosine, sine = np.cos(self.turn_rad), np.sin(self.turn_rad)
        return np.array([[cosine, sine], [-sine, cosine]])


@dataclass(frozen=True)
class FoldPlan:
    """A fold of the current shape along one line."""

    line_m: tuple[tuple[float, float], tuple[float, float]]
    """Two points of the table, where the line crosses the shape's bounding box."""

    grasps_m: tuple[tuple[float, float], ...]
    """One or two points of the table."""

    drops_m: tuple[tuple[float, float], ...]
    """Where they come to lie: their mirror images."""


def garment_frame(mask: NDArray[np.bool_], camera: Camera) -> GarmentFrame:
    """The axes of a garment, along the straight edges of its mask; sleeves are left aside.

    Turns up to `MOST_TURN_DEG` either way are told apart; a garment further round is taken for one
    that lies across.

    Args:
        mask: bool[H, W], where the camera sees the garment.
        camera: that saw it.

    Raises:
        ValueError: the mask is empty.
    """
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        raise ValueError("mask: expected at least one pixel of cloth; got none; reset the cloth")
    centroid_px = (float(columns.mean()) + 0.5, float(rows.mean()) + 0.5)
    return GarmentFrame(camera.table_point_m(centroid_px), np.deg2rad(_turn_deg(mask)))


def plan_fold(mask: NDArray[np.bool_], camera: Camera, line: int) -> FoldPlan:
    """Where to grasp and where to let go for one of the six lines.

    The hands take the two corners of the moving part that are farthest apart along the line and
    farthest from it.

    Args:
        mask: bool[H, W], where the camera sees the garment.
        camera: that saw it.
        line: 0 to 2 cut the shape's width on its left, in the middle and on its right, 3 to 5 its
            length, from below. Lines 0, 1, 3 and 4 fold right or up, 2 and 5 left or down.

    Raises:
        ValueError: the mask is empty, or there is no such line.
    """
    if not 0 <= line < N_FOLD_LINES:
        raise ValueError(f"line: expected 0 to {N_FOLD_LINES - 1}; got {line}; choose one of them")
    frame = garment_frame(mask, camera)
    shape_m = frame.coordinates_m(_table_points_m(mask, camera))
    axis, portion, direction = _LINES[line]
    cut_m = _cut_m(shape_m[:, axis], portion, 1.5 / camera.px_per_m)
    ends = np.stack([shape_m.min(axis=0), shape_m.max(axis=0)])
    ends[:, axis] = cut_m
    inner_m = frame.coordinates_m(_table_points_m(_inner(mask), camera))
    grasps = _grasps(inner_m, (cut_m - inner_m[:, axis]) * direction, inner_m[:, 1 - axis])
    drops = grasps.copy()
    drops[:, axis] = 2 * cut_m - grasps[:, axis]
    return FoldPlan(
        _points(frame.on_table_m(ends))[:2],  # type: ignore[arg-type]
        _points(frame.on_table_m(grasps)),
        _points(frame.on_table_m(drops)),
    )


def fold(
    vertices_in_world: NDArray[np.float64], plan: FoldPlan, motion: GripperMotion = FOLD_MOTION
) -> Gesture:
    """The gesture of a plan: hands close around the edge, all layers, and fold it over the line.

    Args:
        vertices_in_world: f64[V, 3], where the cloth is, metres.
        plan: of this shape.
        motion: speed and the height of letting go.
    """
    hands: list[Hand] = []
    taken: set[int] = set()
    for grasp_m, drop_m in zip(plan.grasps_m, plan.drops_m, strict=True):
        grasped = [
            v for v in pinched_vertices(vertices_in_world, grasp_m).tolist() if v not in taken
        ]
        if grasped:
            taken |= set(grasped)
            way_m = np.subtract(drop_m, grasp_m)
            hands.append(_folding_hand(vertices_in_world, np.array(grasped), way_m, motion))
    return Gesture(tuple(hands), motion)


def _turn_deg(mask: NDArray[np.bool_]) -> float:
    trunk = _trunk(mask).astype(np.float32)
    coarse = np.arange(-MOST_TURN_DEG, MOST_TURN_DEG + 1e-9, COARSE_STEP_DEG)
    best = _straightest(trunk, coarse)
    fine = best + np.arange(-COARSE_STEP_DEG, COARSE_STEP_DEG + 1e-9, FINE_STEP_DEG)
    return _straightest(trunk, fine)


def _trunk(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask without what is much narrower than its thickest part: without sleeves."""
    whole = np.pad(mask.astype(np.uint8), 1)
    thickest_px = float(cv2.distanceTransform(whole, cv2.DIST_L2, 5).max())
    radius_px = max(1, round(TRUNK_PORTION * thickest_px))
    side = 2 * radius_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    opened = cv2.morphologyEx(whole, cv2.MORPH_OPEN, disc)
    return np.asarray((opened if opened.any() else whole)[1:-1, 1:-1] > 0)


def _straightest(mask: NDArray[np.float32], turns_deg: NDArray[np.float64]) -> float:
    """The turn that undone lays the mask's edges along rows and columns; of equals the smallest."""
    rows, columns = np.nonzero(mask)
    centroid = (float(columns.mean()), float(rows.mean()))
    middle = ((mask.shape[1] - 1) / 2, (mask.shape[0] - 1) / 2)
    merits = []
    for turn_deg in turns_deg:
        # OpenCV's positive angle turns counter-clockwise; we turn back.
        matrix = cv2.getRotationMatrix2D(centroid, -turn_deg, 1.0)
        matrix[:, 2] += np.subtract(middle, centroid)
        upright = cv2.warpAffine(mask, matrix, mask.shape[::-1], flags=cv2.INTER_LINEAR)
        # Where edges lie along them, the sums of rows and columns change most suddenly.
        changes = [np.diff(upright.sum(axis=axis)) for axis in (0, 1)]
        merits.append(float(sum((change**2).sum() for change in changes)))
    order = np.lexsort((np.abs(turns_deg), -np.round(merits, 3)))
    return float(turns_deg[order[0]])


def _cut_m(across_m: NDArray[np.float64], portion: float, bin_m: float) -> float:
    """Where a line cuts a shape, for the coordinates of its points across the line.

    On either side that is where the shape's thickness changes most, as where sleeves begin; where
    it does so at the very edge, it is a quarter.
    """
    low, high = float(across_m.min()), float(across_m.max())
    cut_m = low + portion * (high - low)
    if portion == 0.5:
        return cut_m
    direction = 1.0 if portion < 0.5 else -1.0
    inwards_m = direction * (across_m - (low if portion < 0.5 else high))
    n_bins = max(4, int((high - low) / 2 / bin_m))
    thickness, edges = np.histogram(inwards_m, n_bins, (0.0, n_bins * bin_m))
    thickness = np.concatenate([[0, 0], thickness])  # there is nothing further out
    jump = max(0, int(np.argmax(thickness[2:] - thickness[:-2])) - 1)
    if edges[jump] < STICKS_OUT_M:
        return cut_m
    return (low if portion < 0.5 else high) + direction * float(edges[jump] + bin_m / 2)


def _inner(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    kernel = np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)
    core = cv2.erode(
        mask.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0
    ).astype(bool)
    return core if core.any() else mask


def _table_points_m(mask: NDArray[np.bool_], camera: Camera) -> NDArray[np.float64]:
    """Middles of the mask's pixels on the table, f64[n, 2], metres."""
    rows, columns = np.nonzero(mask)
    return camera.table_points_m(np.stack([columns, rows], axis=1) + 0.5)


def _grasps(
    inner_m: NDArray[np.float64],
    from_line_m: NDArray[np.float64],
    along_line_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """One or two of the points f64[n, 2], the farthest from the line first, f64[k, 2]."""
    farthest_m = float(from_line_m.max())  # below 0 where nothing lies beyond the line
    moving = np.flatnonzero(from_line_m >= min(LEAST_PORTION * farthest_m, farthest_m))
    hull = cv2.convexHull(inner_m[moving].astype(np.float32), returnPoints=False)
    corners = moving[hull.reshape(-1)]
    far_m, along_m = from_line_m[corners], along_line_m[corners]
    merit = np.abs(along_m[:, None] - along_m) + 1.5 * (far_m[:, None] + far_m)
    one, two = np.unravel_index(int(merit.argmax()), merit.shape)
    first, second = (one, two) if far_m[one] >= far_m[two] else (two, one)
    if np.linalg.norm(inner_m[corners[first]] - inner_m[corners[second]]) < HANDS_APART_M:
        return np.asarray(inner_m[corners[[far_m.argmax()]]])
    return np.asarray(inner_m[corners[[first, second]]])


def _folding_hand(
    vertices_in_world: NDArray[np.float64],
    grasped: NDArray[np.int64],
    way_m: NDArray[np.float64],
    motion: GripperMotion,
) -> Hand:
    """A hand that moves on a half circle over the line, and turns what it holds upside down."""
    start = vertices_in_world[grasped[0]]
    portion = np.arange(1, FOLD_STATIONS + 1) / FOLD_STATIONS
    length_m = float(np.linalg.norm(way_m))
    xy_m = start[:2] + (1 - np.cos(np.pi * portion))[:, None] / 2 * way_m
    floor_m = start[2] + portion * (motion.release_height_m - start[2])
    z_m = floor_m + min(length_m / 2, HIGHEST_M) * np.sin(np.pi * portion)
    if length_m < 1e-6:  # what lies on the line is lifted and put back
        return Hand(grasped, np.column_stack([xy_m, z_m]))
    along_x, along_y = (way_m / length_m).tolist()
    return Hand(grasped, np.column_stack([xy_m, z_m]), np.pi * portion, (-along_y, along_x, 0.0))


def _points(array: NDArray[np.float64]) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in array)
