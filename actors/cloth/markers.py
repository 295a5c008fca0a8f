"""Coloured markers on a garment: painted in simulation, found in any picture by their hue."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from actors.cloth.garments import Garment
from actors.cloth.rasteriser import ClothColours, Paint, Rgb

MARKER_RADIUS_M = 0.024
LEAST_SATURATION = 130
LEAST_VALUE = 60
LEAST_PX = 3
"""Fewer pixels of a marker's hue are noise."""


@dataclass(frozen=True)
class Marker:
    """A patch of colour around a keypoint."""

    colour: Rgb
    """Before shading."""

    hue: int
    """As OpenCV gives it, 0 to 179."""

    on_both_sides: bool
    """Else it is seen on the garment's front alone."""


TSHIRT_MARKERS: Final[Mapping[str, Marker]] = {
    "sleeve_left": Marker((235, 215, 20), 27, on_both_sides=False),
    "sleeve_right": Marker((60, 200, 40), 56, on_both_sides=False),
    "hem_left": Marker((225, 40, 30), 1, on_both_sides=True),
    "hem_right": Marker((225, 40, 205), 152, on_both_sides=True),
}
"""By keypoint, for a blue garment: hues at least 20 apart from each other and from blue's 115.

A sleeve's marker vanishes when it is folded in; the hem's is followed to where it is folded up.
"""
HUE_TOLERANCE = 9


def painted(garment: Garment, colours: ClothColours, markers: Mapping[str, Marker]) -> Paint:
    """The garment's colours with markers at its keypoints.

    A face belongs to a marker if its middle lies within `MARKER_RADIUS_M` of the keypoint on the
    garment at rest; the markers of a garment that was enlarged are enlarged too by being made of
    faces.

    Raises:
        ValueError: the garment lacks a marker's keypoint.
    """
    if missing := sorted(set(markers) - set(garment.keypoints)):
        raise ValueError(
            f"garment {garment.name}: expected keypoints {', '.join(markers)}; got none for "
            f"{', '.join(missing)}; name them when the garment is made"
        )
    vertices = garment.mesh.vertices_m
    middles = vertices[garment.mesh.faces].mean(axis=1)
    front = np.tile(np.array(colours.front, dtype=np.uint8), (len(middles), 1))
    back = np.tile(np.array(colours.back, dtype=np.uint8), (len(middles), 1))
    for name, marker in markers.items():
        away_m = np.linalg.norm(middles - vertices[garment.keypoints[name]], axis=1)
        front[away_m < MARKER_RADIUS_M] = marker.colour
        if marker.on_both_sides:
            back[away_m < MARKER_RADIUS_M] = marker.colour
    return Paint(front, back)


def found_markers(
    picture: NDArray[np.uint8], markers: Mapping[str, Marker]
) -> dict[str, tuple[float, float]]:
    """Where markers are seen: the centroid of the largest patch of each hue.

    Args:
        picture: u8[H, W, 3].
        markers: by name.

    Returns:
        x and y by name, from 0 at the picture's left and top to 1; what is not seen is left out.
    """
    hue, saturation, value = cv2.split(cv2.cvtColor(picture, cv2.COLOR_RGB2HSV))
    vivid = (saturation >= LEAST_SATURATION) & (value >= LEAST_VALUE)
    found = {}
    for name, marker in markers.items():
        away = np.abs(hue.astype(np.int16) - marker.hue)
        patch = vivid & (np.minimum(away, 180 - away) <= HUE_TOLERANCE)
        _, _, stats, centroids = cv2.connectedComponentsWithStats(patch.astype(np.uint8), None)
        areas = stats[1:, cv2.CC_STAT_AREA]
        if len(areas) and areas.max() >= LEAST_PX:
            x, y = centroids[1 + int(areas.argmax())] + 0.5
            found[name] = (float(x / picture.shape[1]), float(y / picture.shape[0]))
    return found
