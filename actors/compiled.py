"""How loops are compiled: by numba, kept on disk for the next process where there is a place."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numba

_log = logging.getLogger(__name__)


def compiler(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator that compiles a function when it is first called, and keeps what it has made.

    numba keeps it beside the module, or else in the user's cache folder. Where neither can be
    written, as in a read-only installation of a user without a home, each process compiles anew.

    Args:
        options: As `numba.njit` takes them.
    """

    def compile_(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError as error:
            _log.info("%s; it is compiled anew by each process: set NUMBA_CACHE_DIR", error)
            return numba.njit(**options)(function)

    return compile_
