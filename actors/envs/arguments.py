"""Checks of what is given to an environment."""

import operator
from typing import SupportsIndex

import numpy as np


def checked_action(action: SupportsIndex, n_actions: int) -> int:
    """The action as a Python integer.

    Raises:
        ValueError: it is not an integer from 0 to n_actions - 1.
    """
    try:
        index = operator.index(action)
    except TypeError:
        index = -1
    if isinstance(action, bool | np.bool_) or not 0 <= index < n_actions:
        raise ValueError(
            f"action: expected an integer from 0 to {n_actions - 1}; got {action!r}; "
            "take it from the environment's action_space"
        )
    return index


def check_render_mode(render_mode: str | None) -> None:
    """Check a render mode.

    Raises:
        ValueError: it is neither None nor "rgb_array".
    """
    if render_mode not in (None, "rgb_array"):
        raise ValueError(
            f"render_mode: expected None or 'rgb_array'; got {render_mode!r}; "
            "show the array in a window of your own"
        )


def check_size(name: str, value: int, least: int) -> None:
    """Check a whole number with a lower bound.

    Raises:
        ValueError: it is not an integer of at least that.
    """
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ValueError(
            f"{name}: expected an integer of at least {least}; got {value!r}; give a larger one"
        )


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Check a number with two bounds, both allowed.

    Raises:
        ValueError: it lies outside of them or is not a number.
    """
    if not low <= value <= high:
        raise ValueError(
            f"{name}: expected a number from {low:g} to {high:g}; got {value!r}; "
            "give one in this range"
        )
