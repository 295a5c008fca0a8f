"""Who keeps a copy of the journal, and how much of it each has: what may be thrown away by then."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

from broker_config.messages import FollowerJoined, JournalRequest, SnapshotTaken


@dataclass
class _Follower:
    held_offset: int = 0
    """All entries before it are on its disk; 0 until it says so in this epoch."""
    heard_at_secs: float = -math.inf
    """Monotonic."""


class Followers:
    """The known followers of a run. Who they are is journaled; where they are, they say themselves.

    Thread-safe.
    """

    def __init__(self) -> None:
        self._followers: dict[str, _Follower] = {}
        self._snapshot_offsets: dict[int, int] = {}
        self._lock = threading.Lock()

    def apply(self, joined: FollowerJoined) -> None:
        """Takes up a follower, now or when the journal is replayed."""
        with self._lock:
            self._followers.setdefault(joined.id, _Follower())

    def forget(self, follower: str | None) -> None:
        """Waits for a follower no more; without a name, for none."""
        with self._lock:
            for name in [follower] if follower else list(self._followers):
                self._followers.pop(name, None)

    def is_known(self, follower: str) -> bool:
        """Whether it has joined."""
        with self._lock:
            return follower in self._followers

    def heard(self, request: JournalRequest, now_secs: float) -> None:
        """Notes how far a follower has come."""
        with self._lock:
            if (follower := self._followers.get(request.id)) is not None:
                follower.held_offset = request.held_offset
                follower.heard_at_secs = now_secs

    def snapshot_taken(self, snapshot: SnapshotTaken, offset: int) -> None:
        """Notes where in the journal a policy version is named."""
        with self._lock:
            self._snapshot_offsets[snapshot.version] = offset

    def missing_versions(self) -> frozenset[int]:
        """The policy versions that some follower does not have yet."""
        with self._lock:
            held = min((it.held_offset for it in self._followers.values()), default=None)
            if held is None:
                self._snapshot_offsets.clear()
                return frozenset()
            offsets = self._snapshot_offsets.items()
            self._snapshot_offsets = {version: at for version, at in offsets if at >= held}
            return frozenset(self._snapshot_offsets)

    def expect(self, now_secs: float) -> None:
        """Lets the patience with each of them begin now."""
        with self._lock:
            for follower in self._followers.values():
                follower.heard_at_secs = now_secs

    def behind(self, end_offset: int, heard_since_secs: float) -> list[str]:
        """Followers that lack entries before `end_offset` and were heard of since a moment."""
        with self._lock:
            return sorted(
                name
                for name, it in self._followers.items()
                if it.held_offset < end_offset and it.heard_at_secs > heard_since_secs
            )
