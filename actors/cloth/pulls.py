"""Pulls that may spread crumpled cloth, found in its picture, each with the area that it promises.

Colour tells the layers apart: a patch is cloth that shows one side without interruption. Where a
patch ends at the bare table there may be a fold, and the patch may be a flap that was turned over
there: then carrying its corner across the fold, as far again, opens it. The flap cannot be larger
than what the spread garment hides now. Lengths are portions of the picture, so that a picture of
any size will do; places are positions in it, x to the right and y down, in pixels.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from actors.cloth.masks import Side, cloth_mask, side_masks
from actors.cloth.pick_points import NoClothInViewError

RIM: Final = 2 / 84
"""Portion of the picture's width that is no more than a rim: outlines are that exact."""

LEAST_PATCH: Final = 6 / 84**2
"""Portion of the picture below which a patch is a speck."""

N_DIRECTIONS: Final = 48

CARRY: Final = 0.9
"""So far a flap's corner is carried, over the way that opens it: a pull beyond drags all along."""

TOO_LARGE, BEHIND, LOST, OFF_MIDDLE, FAR = 0.5, 0.5, 1.0, 0.15, 0.1
"""What a pixel costs that is more than what is hidden; that lies behind the corner and cannot come
along; that would leave the picture; then portions of the hidden area: for a drop at the picture's
rim instead of its middle, and for a fold half a picture away."""

STRETCH: Final = 0.35
"""Portion of the hidden area that pulling an end outwards may bring at best."""

STRETCH_BEYOND: Final = 0.05
"""So far an end is pulled beyond where it belongs, in diagonals of half the spread square."""

FOLLOWS: Final = 0.5
"""Cloth that is pulled aside slides on beyond the hand: the portion of the way for the hand."""

Points = NDArray[np.float64]
"""f64[n, 2], x and y in pixels."""


class PullKind(StrEnum):
    """What a pull is for."""

    UNFOLD = "unfold"
    """Carry a flap's corner across its fold."""

    STRETCH = "stretch"
    """Pull an end away from the cloth's centroid."""

    TURN = "turn"
    """Carry an end over the whole of the cloth."""

    CENTRE = "centre"
    """Pull the whole cloth towards the picture's middle."""


@dataclass(frozen=True)
class Pull:
    """One pick and drop."""

    kind: PullKind
    pick_px: tuple[float, float]
    drop_px: tuple[float, float]
    """May lie outside of the picture."""

    promise_px: float
    """The area that it may bring, less what speaks against it."""


def spreading_pulls(picture: NDArray[np.uint8], flat_px: int, up: Side | None = None) -> list[Pull]:
    """All pulls that may bring area.

    Args:
        picture: u8[H, H, 3].
        flat_px: pixels that the spread garment covers in it.
        up: the side that is to be up in the end; None where either will do.

    Raises:
        ValueError: it is not such a picture.
        NoClothInViewError: it shows no cloth.
    """
    mask = cloth_mask(picture)
    _check_any(mask)
    hidden_px = max(0, flat_px - int(mask.sum()))
    # A flap that shows the right side would show the wrong one when opened.
    to_open = [seen for side, seen in side_masks(picture).items() if side != up]
    patches = [patch for seen in to_open for patch in _patches(seen)]
    unfolding = [pull for patch in patches for pull in _unfolding(patch, mask, hidden_px)]
    return unfolding + _stretching(mask, flat_px, hidden_px)


def centring_pull(mask: NDArray[np.bool_], middle_px: tuple[float, float]) -> Pull:
    """Drag cloth, bool[H, H], by its foremost point towards a place, so that the rest trails.

    Raises:
        NoClothInViewError: there is no cloth.
    """
    _check_any(mask)
    places = _places(mask)
    way = np.array(middle_px) - places.mean(axis=0)
    length_px = float(np.linalg.norm(way))
    ahead = places @ (way / max(length_px, 1.0))
    pick = _nearest(_places(_inside(mask)), places[ahead.argmax()])
    return Pull(PullKind.CENTRE, _pair(pick), _pair(pick + FOLLOWS * way), 0.0)


def turning_pull(mask: NDArray[np.bool_], towards: int) -> Pull:
    """Carry the end of spread cloth, bool[H, H], over all the rest of it, so that it turns over.

    The way leads to a corner of the picture, where it is longest: the end then lies beyond the one
    that it was carried over, and the more so, the more of the cloth has turned.

    Args:
        mask: where the cloth is.
        towards: which of the picture's 4 corners.

    Raises:
        NoClothInViewError: there is no cloth.
    """
    _check_any(mask)
    drop = float(len(mask)) * np.array([towards % 2, towards // 2], dtype=np.float64)
    pick = max(_corners(mask), key=lambda corner: float(np.linalg.norm(corner - drop)))
    return Pull(PullKind.TURN, _pair(pick), _pair(drop), 0.0)


def touches_border(mask: NDArray[np.bool_]) -> bool:
    """Whether cloth, bool[H, H], goes on beyond the picture: more than a rim of it at the edge."""
    inner = np.zeros_like(mask)
    inner[1:-1, 1:-1] = True
    return int((mask & ~inner).sum()) > RIM * len(mask)


def _unfolding(patch: NDArray[np.bool_], mask: NDArray[np.bool_], hidden_px: int) -> Iterator[Pull]:
    """A pull for each corner and direction in which the patch ends at the bare table."""
    places, half, rim_px = _places(patch), len(mask) / 2, RIM * len(mask)
    for corner in _corners(patch):
        for direction in _DIRECTIONS:
            to_fold_px = _way_to_fold_px(patch, mask, corner, direction)
            if to_fold_px is None or to_fold_px < rim_px:
                continue
            along = (places - corner) @ direction
            behind = along < -rim_px
            flap = ~behind & (along < to_fold_px)
            opened = places[flap] + 2 * (to_fold_px - along[flap])[:, None] * direction
            gained_px, lost_px = _uncovered(opened, mask)
            drop = corner + 2 * CARRY * to_fold_px * direction
            off_middle = float(np.linalg.norm(drop - half)) / half
            promise_px = (
                min(gained_px, hidden_px)
                - TOO_LARGE * max(0, int(flap.sum()) - hidden_px)
                - BEHIND * int(behind.sum())
                - LOST * lost_px
                - OFF_MIDDLE * hidden_px * off_middle
                - FAR * hidden_px * to_fold_px / half
            )
            yield Pull(PullKind.UNFOLD, _pair(corner), _pair(drop), promise_px)


def _stretching(mask: NDArray[np.bool_], flat_px: int, hidden_px: int) -> list[Pull]:
    """A pull for each end of the cloth, to where the corner of a spread square would lie."""
    centroid, half, reach_px = _places(mask).mean(axis=0), len(mask) / 2, np.sqrt(flat_px / 2)
    pulls = []
    for corner in _corners(mask):
        away = corner - centroid
        distance_px = max(float(np.linalg.norm(away)), 1.0)
        short = max(0.0, 1.0 - distance_px / reach_px)
        drop = corner + away / distance_px * reach_px * max(0.1, short + STRETCH_BEYOND)
        off_middle = float(np.linalg.norm(drop - half)) / half
        promise_px = hidden_px * (STRETCH * min(1.0, 0.2 + short) - OFF_MIDDLE * off_middle)
        pulls.append(Pull(PullKind.STRETCH, _pair(corner), _pair(drop), promise_px))
    return pulls


def _way_to_fold_px(
    patch: NDArray[np.bool_], mask: NDArray[np.bool_], corner: Points, direction: Points
) -> float | None:
    """How far the patch reaches; None where other cloth or the picture's end follows."""
    size = len(mask)
    way = np.rint(corner - 0.5 + np.arange(1, 2 * size)[:, None] * direction).astype(int)
    columns, rows = way[((way >= 0) & (way < size)).all(axis=1)].T
    outside = np.flatnonzero(~patch[rows, columns])
    if len(outside) == 0:
        return None
    beyond_px = int(mask[rows, columns][outside[0] :].sum())
    return float(outside[0]) + 0.5 if beyond_px <= RIM * size else None


def _uncovered(places: Points, mask: NDArray[np.bool_]) -> tuple[int, int]:
    """How many pixels of bare table places fall on, and how many places fall out of the picture."""
    pixels = np.floor(places).astype(int)
    seen = ((pixels >= 0) & (pixels < len(mask))).all(axis=1)
    columns, rows = pixels[seen].T
    covered = np.zeros_like(mask)
    covered[rows, columns] = True
    return int((covered & ~mask).sum()), int((~seen).sum())


def _patches(side: NDArray[np.bool_]) -> Iterator[NDArray[np.bool_]]:
    """The connected parts of what shows one side of the cloth, but for specks."""
    number, labels, statistics, _ = cv2.connectedComponentsWithStats(
        side.astype(np.uint8), connectivity=4
    )
    for label in range(1, number):
        if statistics[label, cv2.CC_STAT_AREA] >= LEAST_PATCH * side.size:
            yield np.asarray(labels == label)


def _corners(region: NDArray[np.bool_]) -> list[Points]:
    """Places a little inside of the corners of a region's outline, where fingers find cloth."""
    outlines, _ = cv2.findContours(
        region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    longest = max(outlines, key=len)
    polygon = cv2.approxPolyDP(longest, RIM * len(region), True).reshape(-1, 2)
    inside = _places(_inside(region))
    return [_nearest(inside, corner + 0.5) for corner in polygon.astype(np.float64)]


def _inside(region: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The region without its rim; the whole of one that is no more than rim."""
    width_px = 2 * max(1, round(0.75 * RIM * len(region))) + 1
    core = cv2.erode(
        region.astype(np.uint8),
        np.ones((width_px, width_px), np.uint8),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    return np.asarray(core > 0) if core.any() else region


def _places(region: NDArray[np.bool_]) -> Points:
    """The middles of a region's pixels."""
    rows, columns = np.nonzero(region)
    return np.asarray(np.stack([columns, rows], axis=1) + 0.5, dtype=np.float64)


def _nearest(places: Points, place: Points) -> Points:
    return np.asarray(places[((places - place) ** 2).sum(axis=1).argmin()])


def _pair(place: Points) -> tuple[float, float]:
    return float(place[0]), float(place[1])


def _check_any(mask: NDArray[np.bool_]) -> None:
    if not mask.any():
        raise NoClothInViewError(
            "picture: expected at least one pixel of cloth; got none; put the cloth into view"
        )


_TURNS_RAD = 2 * np.pi * np.arange(N_DIRECTIONS) / N_DIRECTIONS
_DIRECTIONS: Final = tuple(np.stack([np.cos(_TURNS_RAD), np.sin(_TURNS_RAD)], axis=1))
