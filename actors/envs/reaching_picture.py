"""Draws the planar arm."""

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from actors.envs.planar_arm import TARGET_M

Colour = Literal["grayscale", "rgb"]

VIEW_HALF_WIDTH_M = 1.05  # everything that an arm of length 1 can reach, and its line's width
_FRACTION_BITS = 6  # OpenCV takes positions in 1/64 pixel
_SHORTEST_LIMB_WITH_JOINTS_PX = 3.0  # on shorter limbs the joints would hide the limbs

_RGB = {
    "limb": (235, 235, 235),
    "joint": (70, 130, 255),
    "effector": (255, 210, 0),
    "target": (230, 40, 40),
}
_GRAY = {"limb": (190,), "joint": (120,), "effector": (255,), "target": (80,)}


def draw_arm(joints_m: NDArray[np.float64], size_px: int, colour: Colour) -> NDArray[np.uint8]:
    """The arm and its target on black, seen from the front.

    The target lies under the arm. Joints are drawn where the limbs are long enough to show.

    Args:
        joints_m: f64[n + 1, 2], from the base to the end effector.
        size_px: width and height of the picture.
        colour: one channel or three.

    Returns:
        u8[size_px, size_px, 1] or u8[size_px, size_px, 3].
    """
    palette = _GRAY if colour == "grayscale" else _RGB
    unit_px = size_px / 84
    picture = np.zeros((size_px, size_px, len(palette["limb"])), dtype=np.uint8)
    points = _picture_points(joints_m, size_px)
    _dot(picture, _picture_points(np.array([TARGET_M]), size_px)[0], 3 * unit_px, palette["target"])
    cv2.polylines(
        picture,
        [points],
        False,
        palette["limb"],
        thickness=max(1, round(2 * unit_px)),
        lineType=cv2.LINE_AA,
        shift=_FRACTION_BITS,
    )
    limb_px = size_px / (2 * VIEW_HALF_WIDTH_M) / (len(joints_m) - 1)
    if limb_px >= _SHORTEST_LIMB_WITH_JOINTS_PX * unit_px:
        for point in points[:-1]:
            _dot(picture, point, 1.5 * unit_px, palette["joint"])
    _dot(picture, points[-1], 2 * unit_px, palette["effector"])
    return picture


def _picture_points(points_m: NDArray[np.float64], size_px: int) -> NDArray[np.int32]:
    px_per_m = size_px / (2 * VIEW_HALF_WIDTH_M)
    # OpenCV's whole numbers are the middles of pixels, hence the half.
    x_px = (points_m[:, 0] + VIEW_HALF_WIDTH_M) * px_per_m - 0.5
    y_px = (VIEW_HALF_WIDTH_M - points_m[:, 1]) * px_per_m - 0.5
    positions: NDArray[np.float64] = np.stack([x_px, y_px], axis=1) * 2.0**_FRACTION_BITS
    return np.rint(positions).astype(np.int32)


def _dot(
    picture: NDArray[np.uint8],
    centre: NDArray[np.int32],
    radius_px: float,
    colour: tuple[int, ...],
) -> None:
    cv2.circle(
        picture,
        (int(centre[0]), int(centre[1])),
        round(radius_px * 2**_FRACTION_BITS),
        colour,
        thickness=cv2.FILLED,
        lineType=cv2.LINE_AA,
        shift=_FRACTION_BITS,
    )
