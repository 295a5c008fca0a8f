"""Where to pick cloth up, found in the picture.

The points are numbered by their direction in the picture, so that an action keeps its meaning
from one picture to the next; numbered from the cloth's own corners, learning collapsed.
"""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from actors.cloth.masks import cloth_mask

GRID_ROWS = 2
GRID_COLUMNS = 3
N_CONTOUR_POINTS = 8
EXTREMES_DEG = (0.0, 25.0, 80.0, 145.0, 180.0, 215.0, 280.0, 335.0)
"""Clockwise from the picture's top; on a spread t-shirt: neck, shoulders, sleeves, hem."""
RIM_PX = 2  # how far inside of the outline a contour point lies, so that it hits cloth

PickPoints = Callable[[NDArray[np.uint8]], NDArray[np.int64]]
"""From a picture u8[H, W, 3] to points i64[n, 2], column and row of a pixel that shows cloth."""


class NoClothInViewError(ValueError):
    """A picture shows no cloth, so that it has no point to pick it up at."""


def grid_pick_points(picture: NDArray[np.uint8]) -> NDArray[np.int64]:
    """2 x 3 points over the cloth's bounding box, each moved to the nearest pixel of cloth.

    Source: chapter 3.3.1, "from 2 x 3 points over its current area". **assumed**: the points are
    the middles of 2 x 3 equal cells.

    Args:
        picture: u8[H, W, 3].

    Returns:
        i64[6, 2], column and row, from the top left, row by row.

    Raises:
        NoClothInViewError: the picture shows no cloth.
    """
    pixels = _cloth_pixels(picture)
    low, high = pixels.min(axis=0), pixels.max(axis=0) + 1
    fractions = [
        ((column + 0.5) / GRID_COLUMNS, (row + 0.5) / GRID_ROWS)
        for row in range(GRID_ROWS)
        for column in range(GRID_COLUMNS)
    ]
    # Half a pixel back, from a position in the picture to the pixel around it.
    return _snapped(low + np.array(fractions) * (high - low) - 0.5, pixels)


def contour_pick_points(picture: NDArray[np.uint8]) -> NDArray[np.int64]:
    """8 points along the cloth's outline and 2 inside of it.

    The outline's points lie at equal distances along it, clockwise from the one that is straight
    above the cloth's centroid. The inner points are the centroids of the cloth's left and right
    halves, each moved to the nearest pixel of cloth. Where the cloth is in several pieces the
    outline is that of the largest.

    Source: chapter 4.3.1 and figure 4.8, which give the number 10 and no rule. **assumed**

    Args:
        picture: u8[H, W, 3].

    Returns:
        i64[10, 2], column and row.

    Raises:
        NoClothInViewError: the picture shows no cloth.
    """
    pixels = _cloth_pixels(picture)
    outline = _clockwise_from_top(_outline(cloth_mask(picture)), pixels.mean(axis=0))
    targets = np.concatenate([_equally_spaced(outline, N_CONTOUR_POINTS), _half_centroids(pixels)])
    return _snapped(targets, pixels)


def extreme_pick_points(picture: NDArray[np.uint8]) -> NDArray[np.int64]:
    """The cloth's outermost points in 8 directions, and 2 inside of it.

    Of equally far points the one nearest to the straight line from the centroid; a pick point lies
    a little inside of the outline. The inner points are those of `contour_pick_points`.

    Source: table 3.3a, "from 10 points over its current area". **assumed**: the directions.

    Args:
        picture: u8[H, W, 3].

    Returns:
        i64[10, 2], column and row, clockwise from the top, then left and right inner point.

    Raises:
        NoClothInViewError: the picture shows no cloth.
    """
    pixels = _cloth_pixels(picture)
    centroid = pixels.mean(axis=0)
    rim = _outline(cloth_mask(picture))
    away = rim - centroid
    extremes = []
    for angle_rad in np.deg2rad(EXTREMES_DEG):
        along = away @ np.array([np.sin(angle_rad), -np.cos(angle_rad)])
        aside = np.abs(away @ np.array([np.cos(angle_rad), np.sin(angle_rad)]))
        outermost = np.flatnonzero(along >= along.max() - 0.5)
        extremes.append(rim[outermost[aside[outermost].argmin()]])
    return _snapped(np.concatenate([np.array(extremes), _half_centroids(pixels)]), pixels)


def _cloth_pixels(picture: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Column and row of each pixel that shows cloth, i64[n, 2]."""
    rows, columns = np.nonzero(cloth_mask(picture))
    if len(rows) == 0:
        raise NoClothInViewError(
            "picture: expected at least one pixel of cloth; got none; reset the cloth"
        )
    return np.stack([columns, rows], axis=1)


def _snapped(targets: NDArray[np.float64], pixels: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each target the nearest pixel of cloth; of equals the topmost, then the leftmost."""
    squared = ((targets[:, None, :] - pixels[None, :, :]) ** 2).sum(axis=2)
    return np.asarray(pixels[squared.argmin(axis=1)])


def _outline(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Pixels around the largest piece of cloth, in order, f64[n, 2]."""
    kernel = np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)
    whole = mask.astype(np.uint8)
    core = cv2.erode(whole, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    outlines, _ = cv2.findContours(
        core if core.any() else whole, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    largest = max(outlines, key=lambda outline: (cv2.contourArea(outline), len(outline)))
    return np.asarray(largest, dtype=np.float64).reshape(-1, 2)


def _clockwise_from_top(
    outline: NDArray[np.float64], centroid: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The outline begun at the point nearest to straight above the centroid, clockwise."""
    x, y = outline[:, 0], outline[:, 1]
    # The picture's y points down, so that the shoelace sum of a clockwise outline is positive.
    if (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() < 0:
        outline = outline[::-1]
    away = outline - centroid
    from_top_rad = np.abs(np.arctan2(away[:, 0], -away[:, 1]))
    # Of points in nearly the same direction the outermost; a fold can cross it more than once.
    upwards = np.flatnonzero(from_top_rad <= from_top_rad.min() + np.deg2rad(2.0))
    start = upwards[away[upwards, 1].argmin()]
    return np.roll(outline, -start, axis=0)


def _equally_spaced(outline: NDArray[np.float64], n_points: int) -> NDArray[np.float64]:
    """Points at equal distances along a closed outline, from its first point on, f64[n, 2]."""
    closed = np.concatenate([outline, outline[:1]])
    sides = np.linalg.norm(np.diff(closed, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(sides)])
    wanted = along[-1] * np.arange(n_points) / n_points
    return np.stack([np.interp(wanted, along, closed[:, k]) for k in range(2)], axis=1)


def _half_centroids(pixels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Centroids of the pixels left and right of their common centroid, f64[2, 2]."""
    left = pixels[:, 0] <= pixels[:, 0].mean()
    right = ~left if not left.all() else left
    return np.stack([pixels[left].mean(axis=0), pixels[right].mean(axis=0)])
