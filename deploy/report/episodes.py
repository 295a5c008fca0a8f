"""Episodes as a journal tells of them: a few numbers of each, and the pictures of three."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from broker_config.messages import AttemptEnded, Trajectory, TrajectoryId, Verdict
from broker_config.preset import SchedulePreset


@dataclass(frozen=True)
class Episodes:
    """One place for each complete ticket, in order of tickets."""

    indices: NDArray[np.int64]
    """i64[n]: of the tickets."""
    returns: NDArray[np.float64]
    """f64[n]: sums of the task's rewards, whatever was learned from."""
    successes: NDArray[np.bool_]
    """bool[n]."""
    steps: NDArray[np.int64]
    """i64[n]."""
    lags: NDArray[np.int64]
    """i64[n]: updates by which the acting policy was behind the newest when its turn came."""

    def __len__(self) -> int:
        return len(self.indices)

    def of(self, tickets: range) -> slice:
        """The places of a range of tickets."""
        low, high = np.searchsorted(self.indices, (tickets.start, tickets.stop))
        return slice(int(low), int(high))


@dataclass(frozen=True)
class ShownEpisode:
    """An episode with its pictures."""

    index: int
    parts: Sequence[Trajectory]
    """One, unless its actor died in between and could not go back."""

    @property
    def return_(self) -> float:
        """Sum of the task's rewards."""
        return sum(part.return_ for part in self.parts)

    @property
    def success(self) -> bool:
        """Whether the task was solved at the end."""
        return self.parts[-1].success


class EpisodeLog:
    """Folds trajectories and their verdicts; pictures of at most a few episodes are in memory.

    Attributes:
        first, best, last: The complete episodes of the lowest and the highest index, and the one
            of the highest return, the earlier of equals.
    """

    def __init__(self, schedule: SchedulePreset) -> None:
        self._schedule = schedule
        self._arrived: dict[TrajectoryId, Trajectory] = {}
        """Those whose verdict comes in the next entry."""
        self._parts: dict[int, list[Trajectory]] = {}
        """Of tickets that are not complete."""
        self._indices, self._steps, self._lags = array("q"), array("q"), array("q")
        self._returns, self._successes = array("d"), array("b")
        self.first: ShownEpisode | None = None
        self.best: ShownEpisode | None = None
        self.last: ShownEpisode | None = None

    def take(self, trajectory: Trajectory) -> None:
        """Takes an attempt, whatever it is worth."""
        self._arrived[trajectory.id] = trajectory

    def end(self, ended: AttemptEnded) -> Trajectory | None:
        """Takes a verdict; returns the trajectory if it counts."""
        trajectory = self._arrived.pop(ended.trajectory, None) if ended.trajectory else None
        if trajectory is None or ended.verdict is not Verdict.ACCEPTED:
            return None
        parts = self._parts.setdefault(ended.ticket, [])
        parts.append(trajectory)
        if ended.is_last_part:
            self._complete(ShownEpisode(ended.ticket, self._parts.pop(ended.ticket)))
        return trajectory

    def _complete(self, episode: ShownEpisode) -> None:
        index = episode.index
        acted_on = episode.parts[0].ticket.policy_version
        self._indices.append(index)
        self._returns.append(episode.return_)
        self._successes.append(episode.success)
        self._steps.append(sum(part.steps for part in episode.parts))
        self._lags.append(self._schedule.updates_before(index) - acted_on)
        if self.first is None or index < self.first.index:
            self.first = episode
        if self.last is None or index > self.last.index:
            self.last = episode
        if self.best is None or _is_better(episode, self.best):
            self.best = episode

    @property
    def repeated(self) -> int:
        """Tickets that were complete more than once: 0, or the journal is wrong."""
        return len(self._indices) - len(np.unique(np.asarray(self._indices, np.int64)))

    @property
    def episodes(self) -> Episodes:
        """What has been folded so far, in order of tickets."""
        indices, at = np.unique(np.asarray(self._indices, np.int64), return_index=True)
        return Episodes(
            indices,
            np.asarray(self._returns, np.float64)[at],
            np.asarray(self._successes, np.int8)[at].astype(np.bool_),
            np.asarray(self._steps, np.int64)[at],
            np.asarray(self._lags, np.int64)[at],
        )


def _is_better(episode: ShownEpisode, than: ShownEpisode) -> bool:
    mine, its = episode.return_, than.return_
    return mine > its or (mine == its and episode.index < than.index)
