"""Which trajectories the samples of D_G are of: what discriminators are told to label."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from broker_config.messages import IterationAnnounced, TrajectoryId, generated_digest

PlainTrajectories = list[list[str | int]]
"""Actor, incarnation, sequence and steps of each, as JSON keeps them."""


class GeneratedSamples:
    """Keeps count as the local memory does: the newest `capacity` samples, oldest first."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._trajectories: deque[tuple[TrajectoryId, int]] = deque()
        self._samples = 0

    def __len__(self) -> int:
        return min(self._samples, self._capacity)

    def add(self, id_: TrajectoryId, steps: int) -> None:
        """Notes a trajectory that was added to the memory."""
        self._trajectories.append((id_, steps))
        self._samples += steps
        while self._samples - self._trajectories[0][1] >= self._capacity:
            self._samples -= self._trajectories.popleft()[1]

    def announce(self, iteration: int) -> IterationAnnounced:
        """What the memory holds now, as the journal and the discriminators are told."""
        ids = tuple(id_ for id_, _ in self._trajectories)
        return IterationAnnounced(iteration, generated_digest(ids, len(self)), len(self), ids)

    def to_plain(self) -> PlainTrajectories:
        """For a checkpoint."""
        return [
            [id_.actor, id_.incarnation, id_.sequence, steps] for id_, steps in self._trajectories
        ]

    def restore(self, plain: Sequence[Sequence[str | int]]) -> None:
        """Goes back to what `to_plain` gave."""
        self._trajectories.clear()
        self._samples = 0
        for actor, incarnation, sequence, steps in plain:
            self.add(TrajectoryId(str(actor), str(incarnation), int(sequence)), int(steps))
