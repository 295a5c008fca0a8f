"""A thread that hands on what arrives in a Zenoh channel, one at a time."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

import zenoh

_log = logging.getLogger(__name__)

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


class Channel(Protocol[T_co]):
    """The receiving end of a Zenoh channel."""

    def recv(self) -> T_co:
        """The next item; raises `zenoh.ZError` when the channel is empty and closed."""


class Declared(Protocol):
    """Something declared on a Zenoh session."""

    def undeclare(self) -> None:
        """Ends it, and closes its channel."""


class Pump(Generic[T]):
    """Takes items from a channel until its source is undeclared.

    An explicit channel instead of Zenoh's callbacks: those queue 256 messages of any size, and keep
    the process from ending when something raises. The channel's handle is read, not the declared
    object itself, which cannot be undeclared while another thread waits in it.
    """

    def __init__(
        self, name: str, declared: Declared, channel: Channel[T], take: Callable[[T], None]
    ) -> None:
        self._declared = declared
        self._channel = channel
        self._take = take
        self._is_closed = False
        # A daemon: a process whose main thread fails must end, not wait for messages.
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stops taking items; what waits in the channel is dropped. Again: does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        self._declared.undeclare()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while not self._is_closed:
            try:
                item = self._channel.recv()
            except zenoh.ZError:
                return  # closed, by us or with the session
            try:
                if not self._is_closed:
                    self._take(item)
            except Exception:
                _log.exception("%s: a message was not handled", self._thread.name)
            del item  # while waiting for the next, this would keep a query open
