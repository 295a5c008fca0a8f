"""What did not decode: counted, logged once, dropped. It never ends a process."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Mapping

_log = logging.getLogger(__name__)

_MAX_KEYS = 1000
OTHER_KEYS = "(other keys)"
"""Counts for the rest once many keys have rejects, so that foreign traffic cannot fill memory."""


class Rejected:
    """Counts rejected messages by key and kind of reason."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, str]] = Counter()
        self._lock = threading.Lock()

    def count(self, key: str, error: Exception) -> None:
        """Counts one, and logs it if it is the first of its key and kind."""
        with self._lock:
            case = (key, type(error).__name__)
            if case not in self._counts and len(self._counts) >= _MAX_KEYS:
                case = (OTHER_KEYS, case[1])
            self._counts[case] += 1
            is_first = self._counts[case] == 1
        if is_first:
            _log.warning("dropped a message on %s, and counts further ones: %s", case[0], error)

    @property
    def counts(self) -> Mapping[tuple[str, str], int]:
        """How many, by key and by name of the error's class."""
        with self._lock:
            return dict(self._counts)

    @property
    def total(self) -> int:
        """How many in all."""
        with self._lock:
            return self._counts.total()
