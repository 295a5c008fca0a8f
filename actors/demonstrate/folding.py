"""A script that folds a t-shirt by pick and drop, from its markers in the picture."""

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.markers import TSHIRT_MARKERS, found_markers
from actors.cloth.pick_points import extreme_pick_points
from actors.envs.tshirt import DROP_POINTS_M, SCRIPT
from actors.envs.tshirt_reward import TARGET_HEMS

HEM_IS_UP = 0.25
"""So high in the picture a hem's marker lies above the fold, in portions from the target."""


def scripted_tshirt_action(picture: NDArray[np.uint8], camera: Camera) -> int:
    """The next action of a rule that folds the sleeves in, then the hem up.

    A sleeve whose marker is seen is carried in; then, while a marker of the hem is seen below, the
    middle of the hem is carried up. Where there is nothing left to do, the point nearest to a drop
    point is dropped there, which disturbs the least.

    Args:
        picture: u8[H, H, 3], an observation.
        camera: that took it.

    Returns:
        Pick point * 20 + drop point.

    Raises:
        NoClothInViewError: the picture shows no cloth.
    """
    seen = found_markers(picture, TSHIRT_MARKERS)
    right_in, left_in, hem_up = (pick * len(DROP_POINTS_M) + drop for pick, drop in SCRIPT)
    if "sleeve_right" in seen:
        return right_in
    if "sleeve_left" in seen:
        return left_in
    hems = [seen[name][1] - place[1] for name, place in TARGET_HEMS.items() if name in seen]
    if max(hems, default=0.0) > HEM_IS_UP:
        return hem_up
    picks_px = extreme_pick_points(picture).astype(np.float64) + 0.5
    drops_px = camera.project_px(np.array([(x, y, 0.0) for x, y in DROP_POINTS_M]))
    return int(np.linalg.norm(picks_px[:, None] - drops_px[None], axis=2).argmin())
