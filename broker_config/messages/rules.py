"""Rules that fields of messages keep, and the errors of those that break them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from broker_config.errors import MessageError

_ID = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
_DIGEST = re.compile(r"[0-9a-f]{64}")


def require_id(subject: str, value: str) -> str:
    """Returns `value` if it can name a run, an actor or an incarnation.

    Raises:
        MessageError: It is empty, too long, or has a character that a key must not have.
    """
    if not _ID.fullmatch(value):
        raise MessageError(
            f"{subject}: expected 1 to 64 of a-z, 0-9, '-', '_', starting with a letter or digit; "
            f"got {value!r}; choose another name"
        )
    return value


def require(condition: bool, subject: str, rule: str, got: object) -> None:
    """Refuses values for which the condition does not hold."""
    if not condition:
        raise MessageError(f"{subject}: expected {rule}; got {got}")


def require_count(subject: str, value: int) -> None:
    """Refuses what is no count of 64 bits."""
    require(0 <= value < 2**63, subject, "a count of 0 or more", value)


def require_digest(subject: str, value: str) -> None:
    """Refuses what is no SHA-256 in hexadecimal."""
    require(bool(_DIGEST.fullmatch(value)), subject, "64 hexadecimal digits", repr(value))


def require_array(
    subject: str, array: NDArray[Any], dtype: str, shape: tuple[int | None, ...]
) -> None:
    """Refuses an array of another dtype or shape; None stands for any size."""
    fits = len(array.shape) == len(shape) and all(
        rule is None or size == rule for size, rule in zip(array.shape, shape, strict=True)
    )
    if array.dtype != np.dtype(dtype) or not fits:
        rule = ", ".join("any" if size is None else str(size) for size in shape)
        raise MessageError(
            f"{subject}: expected {dtype} [{rule}]; got {array.dtype} {list(array.shape)}"
        )
