"""What observers look at: best effort, with sequence numbers by which a gap shows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from broker_config.messages.presence import Role
from broker_config.messages.rules import require, require_count, require_id


@dataclass(frozen=True)
class Metrics:
    """Named numbers of one moment of a process."""

    role: Role
    id: str
    incarnation: str
    sequence: int
    """Counts the messages of this incarnation under this key."""
    step: int
    """The count against which the numbers are plotted: episodes absorbed, for the learner."""
    numbers: Mapping[str, float]

    def __post_init__(self) -> None:
        require_id("metrics.id", self.id)
        require_id("metrics.incarnation", self.incarnation)
        require_count("metrics.sequence", self.sequence)
        require_count("metrics.step", self.step)


@dataclass(frozen=True)
class View:
    """A small picture of what an actor sees, with what it has just done."""

    actor: str
    incarnation: str
    sequence: int
    """Counts the messages of this incarnation under this key."""
    ticket: int
    """Index of the ticket that is played."""
    attempt: int
    policy_version: int
    step: int
    """Steps of the episode so far; 0 shows the first state, before any action."""
    action: int | None
    """Index of the action that led here; None at step 0."""
    reward: float | None
    """What it earned."""
    picture: bytes
    """An encoded picture."""
    picture_format: Literal["png", "jpeg"]
    unix_secs: float
    """Wall clock of the actor's host; for people, never for ordering."""

    def __post_init__(self) -> None:
        require_id("view.actor", self.actor)
        require_id("view.incarnation", self.incarnation)
        for name in ("sequence", "ticket", "attempt", "policy_version", "step"):
            require_count(f"view.{name}", getattr(self, name))
        has_both = self.action is not None and self.reward is not None
        has_none = self.action is None and self.reward is None
        rule = "action and reward together, and none at step 0"
        require(has_none if self.step == 0 else has_both, "view.action", rule, self.action)
        require(math.isfinite(self.unix_secs), "view.unix_secs", "a finite time", self.unix_secs)
