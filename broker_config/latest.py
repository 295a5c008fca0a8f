"""The newest message of a key, read without a backlog."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

M = TypeVar("M")


class LatestReader(Generic[M]):
    """Holds the newest of the messages that arrived, and lets threads wait for one.

    Made by `Bus.latest_reader`.
    """

    def __init__(self) -> None:
        self._newest: M | None = None
        self._arrival = threading.Condition()
        self._is_closed = False

    def set(self, message: M) -> None:
        """Replaces the newest message."""
        with self._arrival:
            self._newest = message
            self._arrival.notify_all()

    def get(self) -> M | None:
        """The newest message, or None before the first."""
        with self._arrival:
            return self._newest

    def wait(
        self, timeout_secs: float, is_wanted: Callable[[M], bool] = lambda _: True
    ) -> M | None:
        """Waits until the newest message is a wanted one.

        Returns:
            That message; None when the time is over or the bus is closed.
        """
        with self._arrival:
            self._arrival.wait_for(lambda: self._is_closed or self._has(is_wanted), timeout_secs)
            return self._newest if self._has(is_wanted) else None

    def close(self) -> None:
        """Wakes whoever waits."""
        with self._arrival:
            self._is_closed = True
            self._arrival.notify_all()

    def _has(self, is_wanted: Callable[[M], bool]) -> bool:
        return self._newest is not None and is_wanted(self._newest)
