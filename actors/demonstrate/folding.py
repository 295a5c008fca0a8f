"""Scripts that fold a t-shirt by pick and drop, from its markers in the picture."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.markers import TSHIRT_MARKERS, found_markers
from actors.cloth.pick_points import extreme_pick_points
from actors.envs.tshirt import DROP_POINTS_M
from actors.envs.tshirt_reward import SLEEVES, TARGET_HEMS, Point

HEM_IS_THERE = 0.12
"""A hem's marker is at its target within this sum of differences, in portions of the picture."""


def scripted_tshirt_action(picture: NDArray[np.uint8], camera: Camera) -> int:
    """The next action of a rule that folds the sleeves in, then the hem up.

    A sleeve that is seen is carried to its mirror image in the line through the hem's end on its
    side; then each end of the hem that is seen and not at its target is carried there. Where there
    is nothing left to do, the point nearest to a drop point is dropped there.

    Args:
        picture: u8[H, H, 3], an observation.
        camera: that took it.

    Returns:
        Pick point * 20 + drop point.

    Raises:
        NoClothInViewError: the picture shows no cloth.
    """
    seen = found_markers(picture, TSHIRT_MARKERS)
    picks_px = extreme_pick_points(picture).astype(np.float64) + 0.5
    drops_px = camera.project_px(np.array([(x, y, 0.0) for x, y in DROP_POINTS_M]))
    size_px = float(len(picture))
    for goal_from, goal_to in _wishes(seen):
        pick = _nearest(picks_px, np.array(goal_from) * size_px)
        drop = _nearest(drops_px, np.array(goal_to) * size_px)
        return pick * len(DROP_POINTS_M) + drop
    carry_px = np.linalg.norm(picks_px[:, None] - drops_px[None], axis=2)
    return int(carry_px.argmin())


def _wishes(seen: Mapping[str, Point]) -> list[tuple[Point, Point]]:
    """From where to where something should be carried, the first thing first."""
    wishes = []
    for sleeve in SLEEVES:
        hem = seen.get(
            sleeve.replace("sleeve", "hem"), TARGET_HEMS[sleeve.replace("sleeve", "hem")]
        )
        if sleeve in seen:
            x, y = seen[sleeve]
            wishes.append(((x, y), (2 * hem[0] - x, y)))
    for name, target in TARGET_HEMS.items():
        if name in seen:
            x, y = seen[name]
            if abs(x - target[0]) + abs(y - target[1]) > HEM_IS_THERE:
                wishes.append(((x, y), target))
    return wishes


def _nearest(points: NDArray[np.float64], place: NDArray[np.float64]) -> int:
    return int(np.linalg.norm(points - place, axis=1).argmin())
