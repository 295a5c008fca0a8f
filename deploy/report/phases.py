"""What the learner's time went into, told from when the journal's entries were committed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from broker_config.preset import SchedulePreset


@dataclass
class PhaseSecs:
    """Of one iteration, in seconds; they add up to its time on the wall clock."""

    episodes: float = 0.0
    """The learner waited for the iteration's episodes."""
    rewards: float = 0.0
    """The iteration was announced, and discriminators owed its rewards."""
    updates: float = 0.0
    """From there to the new policy in the journal: gradient steps, checkpoint, snapshot."""
    away: float = 0.0
    """From the owner's last entry before it died or was stopped to its next start."""

    @property
    def total(self) -> float:
        """All of it."""
        return self.episodes + self.rewards + self.updates + self.away


class PhaseClock:
    """Folds commit times (wall clock, seconds) into the phases of each iteration.

    An owner that is away stops the clock: what it does again afterwards counts where it is done.
    """

    def __init__(self, schedule: SchedulePreset) -> None:
        self._schedule = schedule
        self._phases: dict[int, PhaseSecs] = {}
        self._away_secs = 0.0
        self._counted_away_secs = 0.0
        self._last_secs: float | None = None
        self._known_at = 0.0
        """When the newest policy was journaled, on this clock."""
        self._ready_at: dict[int, float] = {}
        """When the last episode came, by the update that waits for it."""
        self._announced_at: float | None = None
        self._rewards_secs = 0.0

    @property
    def away_secs(self) -> float:
        """In all."""
        return self._away_secs

    @property
    def phases(self) -> Mapping[int, PhaseSecs]:
        """By iteration, from 0; those that have led to a policy."""
        return self._phases

    def tick(self, unix_secs: float, *, starts_owner: bool = False) -> None:
        """Must hear of every entry, before what it says is told."""
        if starts_owner and self._last_secs is not None:
            self._away_secs += max(0.0, unix_secs - self._last_secs)
        self._last_secs = unix_secs

    def episode_ended(self, ticket: int) -> None:
        """A ticket is complete."""
        self._ready_at[self._schedule.updates_before(ticket)] = self._now

    def announced(self) -> None:
        """An iteration waits for its rewards."""
        self._announced_at = self._now

    def rewarded(self) -> None:
        """It has them."""
        if self._announced_at is not None:
            self._rewards_secs = max(0.0, self._now - self._announced_at)
            self._announced_at = None

    def policy_known(self, version: int) -> None:
        """A policy version is in the journal; 0 is the untrained one."""
        before, self._known_at = self._known_at, self._now
        if version == 0:
            return
        update = version - 1
        ready = max(before, self._ready_at.pop(update, before))
        phases = self._phases.setdefault(self._iteration(update), PhaseSecs())
        phases.episodes += ready - before
        phases.rewards += self._rewards_secs
        phases.updates += max(0.0, self._now - ready - self._rewards_secs)
        phases.away += self._away_secs - self._counted_away_secs
        self._counted_away_secs, self._rewards_secs = self._away_secs, 0.0

    @property
    def _now(self) -> float:
        return (self._last_secs or 0.0) - self._away_secs

    def _iteration(self, update: int) -> int:
        if self._schedule.update_every == "iteration":
            return update
        return update // self._schedule.episodes_per_iteration
