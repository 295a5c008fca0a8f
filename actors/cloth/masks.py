"""Finds the cloth and its red side in a picture, by colour alone.

The same functions serve a real camera over a nearly grey table: nothing here knows the simulator.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Side = Literal["green", "red"]
"""Of the handkerchief: its front is green, its back red."""

# Largest less smallest channel. The drawn table has 20; the drawn cloth, in its darkest shade, 58.
LEAST_SATURATION = 40


def cloth_mask(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where the picture shows cloth, bool[H, W], for a picture u8[H, W, 3].

    Raises:
        ValueError: it is not such a picture.
    """
    _check_picture(picture)
    saturation: NDArray[np.uint8] = picture.max(axis=2) - picture.min(axis=2)
    return saturation > LEAST_SATURATION


def red_mask(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where the picture shows cloth with its red side up, bool[H, W], for u8[H, W, 3].

    Raises:
        ValueError: it is not such a picture.
    """
    red_strongest: NDArray[np.bool_] = picture.argmax(axis=2) == 0
    return cloth_mask(picture) & red_strongest


def side_masks(picture: NDArray[np.uint8]) -> dict[Side, NDArray[np.bool_]]:
    """Where the picture shows which side of the cloth, bool[H, W], for a picture u8[H, W, 3].

    Raises:
        ValueError: it is not such a picture.
    """
    red = red_mask(picture)
    return {"red": red, "green": cloth_mask(picture) & ~red}


def _check_picture(picture: NDArray[np.uint8]) -> None:
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise ValueError(
            f"picture: expected uint8 [H, W, 3]; got {picture.dtype} {list(picture.shape)}; "
            "the cloth is found by its colours, so that a grey picture does not do"
        )
