"""What waits for the recorder's one writing thread: bounded, and whoever must not wait does not."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from broker_config.messages import JournalEntry, Metrics, Presence, Snapshot, View

Live = View | Metrics | Presence

LIVE_BYTES = 64 << 20
"""Best-effort messages that wait; with more than this, the oldest make way."""

_OTHER_BYTES = 2048
"""What a message without a picture is taken to need."""


@dataclass(frozen=True)
class LostSnapshot:
    """The weights of a version that the owner no longer has."""

    version: int


@dataclass(frozen=True)
class JournalPart:
    """Some of the journal, in order: each entry after the weights that it names."""

    items: Sequence[JournalEntry | Snapshot | LostSnapshot]
    end_of_batch: bool


class RecorderInbox:
    """Takes from many threads, gives to one.

    Attributes:
        dropped: Best-effort messages that made way.
    """

    def __init__(self, live_bytes: int = LIVE_BYTES) -> None:
        self.dropped = 0
        self._live_bytes = live_bytes
        self._live: deque[tuple[Live, int]] = deque()
        self._waiting_bytes = 0
        self._part: JournalPart | None = None
        self._is_closed = False
        self._changed = threading.Condition()

    def offer(self, message: Live) -> None:
        """Takes a best-effort message, and waits for nobody."""
        size = _size_of(message)
        with self._changed:
            self._live.append((message, size))
            self._waiting_bytes += size
            while self._waiting_bytes > self._live_bytes:
                self._waiting_bytes -= self._live.popleft()[1]
                self.dropped += 1
            self._changed.notify_all()

    def hand_over(self, part: JournalPart) -> bool:
        """Waits until the part before was taken, so that one waits at most.

        Returns:
            Whether it will be written; False once the inbox takes no more of the journal.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._part is None or self._is_closed)
            if self._is_closed:
                return False
            self._part = part
            self._changed.notify_all()
            return True

    def take(self, timeout_secs: float) -> tuple[list[Live], JournalPart | None]:
        """Everything that waits; nothing, if nothing comes in time."""
        deadline_secs = time.monotonic() + timeout_secs
        with self._changed:
            self._changed.wait_for(
                lambda: self._live or self._part is not None, deadline_secs - time.monotonic()
            )
            live = [message for message, _ in self._live]
            self._live.clear()
            self._waiting_bytes = 0
            part, self._part = self._part, None
            self._changed.notify_all()
        return live, part

    def open_journal(self) -> None:
        """Takes parts of the journal from now on; none is left from before."""
        with self._changed:
            self._part = None
            self._is_closed = False

    def close_journal(self) -> None:
        """Takes no more of the journal; whoever waits in `hand_over` goes on."""
        with self._changed:
            self._is_closed = True
            self._part = None
            self._changed.notify_all()


def _size_of(message: Live) -> int:
    if not isinstance(message, View):
        return _OTHER_BYTES
    motion = message.motion
    return len(message.picture) + (0 if motion is None else motion.angles_rad.nbytes)
