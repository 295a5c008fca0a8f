"""Fills an outline with triangles that make a cloth equally stiff in all directions.

Inside lies a square grid with alternating diagonals, as in `rectangular_sheet`; along the outline
lie points of its own, so that hems and cuffs are straight whatever the garment's size.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from actors.cloth.meshes import ClothMesh
from actors.cloth.outlines import Outline

MARGIN = 0.55
"""Grid points nearer to the outline than this many spacings are left out."""
LEAST_AREA = 0.05
"""Triangles smaller than this many squared spacings are slivers along a straight side."""
MISSING_PORTION = 0.01


def triangulated(outline: Outline, spacing_m: float) -> ClothMesh:
    """A mesh of an outline, with vertices about `spacing_m` > 0 apart.

    The grid is symmetric to x = 0, and its rows begin at the lowest side.

    Raises:
        ValueError: the spacing is too large for the outline's narrow parts.
    """
    # Only garments need it, and it brings all of matplotlib.
    from matplotlib.tri import Triangulation

    corners = outline.corners_m
    rim = _along(corners, spacing_m)
    grid, cells = _grid_inside(corners, spacing_m)
    points = np.concatenate([grid, rim])
    faces = Triangulation(points[:, 0], points[:, 1]).triangles.astype(np.int32)
    a, b, c = (points[faces[:, k]] for k in range(3))
    areas = _cross(b - a, c - a) / 2
    kept = (areas > LEAST_AREA * spacing_m**2) & _inside(corners, (a + b + c) / 3, 0.0)
    faces = _with_alternating_diagonals(faces[kept], cells)
    missing = abs(areas[kept].sum() / _area(corners) - 1.0)
    if missing > MISSING_PORTION or len(np.unique(faces)) < len(points):
        raise ValueError(
            f"spacing_m: expected triangles that fill the outline; got {missing:.1%} too little "
            f"or too much with {spacing_m} m; make the spacing smaller, or narrow parts wider"
        )
    vertices_m = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    return ClothMesh(vertices_m, np.ascontiguousarray(faces))


def _along(corners: NDArray[np.float64], spacing_m: float) -> NDArray[np.float64]:
    """Points along a closed outline, each side in equal parts, f64[n, 2]."""
    sides = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        n_parts = max(1, round(float(np.linalg.norm(end - start)) / spacing_m))
        sides.append(start + np.arange(n_parts)[:, None] / n_parts * (end - start))
    return np.concatenate(sides)


def _grid_inside(
    corners: NDArray[np.float64], spacing_m: float
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Grid points inside, f64[n, 2], and the cells that have all four corners.

    Returns:
        The points, and i32[cells, 5]: parity, then the ids of the lower left, lower right, upper
        left and upper right corner.
    """
    low, high = corners.min(axis=0), corners.max(axis=0)
    reach = int(np.ceil(max(high[0], -low[0]) / spacing_m))
    x_m = np.arange(-reach, reach + 1) * spacing_m
    y_m = np.arange(low[1], high[1] + spacing_m, spacing_m)
    rows, columns = np.meshgrid(np.arange(len(y_m)), np.arange(len(x_m)), indexing="ij")
    points = np.stack([x_m[columns], y_m[rows]], axis=-1)
    inside = _inside(corners, points.reshape(-1, 2), MARGIN * spacing_m).reshape(rows.shape)
    ids = np.full(rows.shape, -1)
    ids[inside] = np.arange(inside.sum())
    a, b, c, d = ids[:-1, :-1], ids[:-1, 1:], ids[1:, :-1], ids[1:, 1:]
    whole = (np.stack([a, b, c, d]) >= 0).all(axis=0)
    parity = ((rows + columns) % 2)[:-1, :-1]
    cells = np.stack([grid[whole] for grid in (parity, a, b, c, d)], axis=1)
    return points[inside], cells.astype(np.int32)


def _with_alternating_diagonals(
    faces: NDArray[np.int32], cells: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Replaces the two triangles of each grid cell by those of a sheet."""
    known = {face.tobytes(): row for row, face in enumerate(np.sort(faces, axis=1))}
    faces = faces.copy()
    for parity, a, b, c, d in cells.tolist():
        rising, falling = [(a, b, d), (a, d, c)], [(a, b, c), (b, d, c)]
        for pair in (rising, falling):
            one, two = (known.get(np.array(sorted(face), np.int32).tobytes()) for face in pair)
            if one is not None and two is not None:
                faces[[one, two]] = rising if parity else falling
    return faces


def _inside(
    corners: NDArray[np.float64], points: NDArray[np.float64], margin_m: float
) -> NDArray[np.bool_]:
    polygon = corners.astype(np.float32)
    distances = [cv2.pointPolygonTest(polygon, (x, y), True) for x, y in points.tolist()]
    return np.asarray(np.array(distances) > margin_m)


def _area(corners: NDArray[np.float64]) -> float:
    return float(_cross(corners, np.roll(corners, -1, axis=0)).sum() / 2)


def _cross(one: NDArray[np.float64], two: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
