"""How loops are compiled: by numba, kept on disk for the next process where there is a place."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

_log = logging.getLogger(__name__)


def compiler(*used: str, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator that compiles a function when it is first called, and keeps what it has made.

    numba keeps it beside the module, or else in the user's cache folder. Where neither can be
    written, as in a read-only installation of a user without a home, each process compiles anew.

    Args:
        used: Other files with compiled functions that it calls: when one of them changes, it is
            compiled anew. Of its own file numba notices that by itself.
        options: As `numba.njit` takes them.
    """

    def compile_(function: Callable[..., Any]) -> Any:
        try:
            dispatcher = numba.njit(cache=True, **options)(function)
        except RuntimeError as error:
            _log.info("%s; it is compiled anew by each process: set NUMBA_CACHE_DIR", error)
            return numba.njit(**options)(function)
        # numba has no public way to say so; tests/unit/actors/test_compiled.py holds it.
        kept = dispatcher._cache._cache_file
        kept._source_stamp = (kept._source_stamp, *map(_stamp, used))
        return dispatcher

    return compile_


def _stamp(file: str) -> tuple[int, int]:
    state = Path(file).stat()
    return state.st_mtime_ns, state.st_size
