"""Which trajectories have arrived, and what became of them: in memory only what is on its way."""

from __future__ import annotations

from collections.abc import Iterable

from broker_config.codec import decode
from broker_config.journal import JournalReader
from broker_config.messages import AttemptEnded, Trajectory, TrajectoryId, Verdict

RECEIVED_BYTES = 64 << 20
"""Of pictures that are kept decoded; the learner absorbs most episodes as they come."""


class Arrivals:
    """Recognises a resend, however old, without keeping every id; for one thread at a time."""

    def __init__(self, journal: JournalReader) -> None:
        self._journal = journal
        self._uncommitted: dict[TrajectoryId, Verdict] = {}
        self._newest: dict[tuple[str, str], int] = {}
        """Highest sequence number by actor and incarnation: what is above it never arrived."""

    def verdict(self, trajectory: TrajectoryId) -> Verdict | None:
        """What became of a trajectory, or None if it never arrived."""
        if trajectory.sequence > self._newest.get((trajectory.actor, trajectory.incarnation), -1):
            return None
        if (verdict := self._uncommitted.get(trajectory)) is not None:
            return verdict
        entry = self._journal.find(f"ended/{trajectory}")
        return None if entry is None else decode(entry.payload, AttemptEnded).verdict

    def arrived(self, trajectory: TrajectoryId, verdict: Verdict) -> None:
        """Notes one that is on its way to the disk."""
        self._uncommitted[trajectory] = verdict
        self._note_newest(trajectory)

    def committed(self, trajectory: TrajectoryId) -> None:
        """Notes one that is in the journal, now or since an earlier epoch."""
        self._uncommitted.pop(trajectory, None)
        self._note_newest(trajectory)

    def are_durable(self, trajectories: Iterable[TrajectoryId]) -> bool:
        """Whether none of these, which have arrived, is still on its way."""
        return self._uncommitted.keys().isdisjoint(trajectories)

    def _note_newest(self, trajectory: TrajectoryId) -> None:
        process = trajectory.actor, trajectory.incarnation
        self._newest[process] = max(trajectory.sequence, self._newest.get(process, -1))


class Received:
    """Trajectories as they were decoded, until they are learned from; the oldest make way.

    What is not here is in the journal: this only saves reading and decoding it again.
    """

    def __init__(self, most_bytes: int = RECEIVED_BYTES) -> None:
        self._most_bytes = most_bytes
        self._bytes = 0
        self._trajectories: dict[TrajectoryId, Trajectory] = {}

    def put(self, trajectory: Trajectory) -> None:
        """Keeps one for a while."""
        self._trajectories[trajectory.id] = trajectory
        self._bytes += trajectory.observations.nbytes
        while self._bytes > self._most_bytes:
            self.take(next(iter(self._trajectories)))

    def take(self, trajectory: TrajectoryId) -> Trajectory | None:
        """Gives one away, if it is still here."""
        found = self._trajectories.pop(trajectory, None)
        if found is not None:
            self._bytes -= found.observations.nbytes
        return found
