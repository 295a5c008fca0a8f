"""Trajectories: what happened, and that it is kept. T counts steps; H, W, C are a picture's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from broker_config.errors import MessageError
from broker_config.messages.rules import require, require_array, require_count, require_id
from broker_config.messages.tickets import Ticket
from broker_config.specs import NetworkSpec


@dataclass(frozen=True)
class TrajectoryId:
    """Names a trajectory for good: a resend carries the same id."""

    actor: str
    incarnation: str
    """Of the actor's process that acted; a restarted actor has another."""
    sequence: int
    """Counts the trajectories of an actor's spool."""

    def __post_init__(self) -> None:
        require_id("trajectory_id.actor", self.actor)
        require_id("trajectory_id.incarnation", self.incarnation)
        require_count("trajectory_id.sequence", self.sequence)

    def __str__(self) -> str:
        return f"{self.actor}/{self.incarnation}/{self.sequence}"


@dataclass(frozen=True)
class Trajectory:
    """What happened: T steps between T + 1 observations."""

    id: TrajectoryId
    ticket: Ticket
    observations: NDArray[np.uint8]
    """u8[T+1, H, W, C]."""
    actions: NDArray[np.int32]
    """i32[T]."""
    rewards: NDArray[np.float32]
    """f32[T], finite."""
    terminated: bool
    """The last state ends the task: no value is bootstrapped from it."""
    truncated: bool
    """The episode ended for another reason: horizon, guard, crash."""
    success: bool
    """Whether the task counts as solved in the last state."""
    guard: str | None
    """Why the environment's guard ended the attempt; such an attempt is never learned from."""
    interrupted: bool
    """The actor died in mid-episode: only the finished steps are here."""
    ended_unix_secs: float
    """Wall clock of the actor's host at the end; for people, never for ordering."""

    def __post_init__(self) -> None:
        steps = len(self.actions)
        require(steps >= 1, "trajectory.actions", "at least one step", f"{steps} steps")
        subject = "trajectory.observations"
        require_array(subject, self.observations, "uint8", (steps + 1, None, None, None))
        require_array("trajectory.actions", self.actions, "int32", (steps,))
        require_array("trajectory.rewards", self.rewards, "float32", (steps,))
        finite = bool(np.isfinite(self.rewards).all())
        require(finite, "trajectory.rewards", "finite numbers", self.rewards.tolist())
        smallest = int(self.actions.min())
        require(smallest >= 0, "trajectory.actions", "indices of 0 or more", smallest)
        require(
            math.isfinite(self.ended_unix_secs),
            "trajectory.ended_unix_secs",
            "a finite time",
            self.ended_unix_secs,
        )

    @property
    def steps(self) -> int:
        """T."""
        return len(self.actions)

    @property
    def return_(self) -> float:
        """Sum of the rewards, undiscounted."""
        return float(np.sum(self.rewards, dtype=np.float64))

    def check_fits(self, spec: NetworkSpec) -> None:
        """Refuses a trajectory that a network of this spec cannot learn from.

        Raises:
            MessageError: Picture shape or an action index differs from the spec's.
        """
        got = self.observations.shape[1:]
        if got != tuple(spec.observation_shape):
            raise MessageError(
                f"trajectory.observations: expected uint8 [T+1, "
                f"{', '.join(map(str, spec.observation_shape))}]; got uint8 "
                f"{list(self.observations.shape)} from {self.id.actor}; "
                "actor and learner run different presets"
            )
        largest = int(self.actions.max())
        if largest >= spec.n_actions:
            raise MessageError(
                f"trajectory.actions: expected indices below {spec.n_actions}; got {largest} from "
                f"{self.id.actor}; actor and learner run different presets"
            )


class Verdict(StrEnum):
    """What became of an attempt."""

    ACCEPTED = "accepted"
    """Enters the memory."""
    SPARE = "spare"
    """Sound, but another attempt of the ticket was complete first."""
    INVALID = "invalid"
    """Guarded, or of a wrong length; kept, never learned from. The ticket is issued again."""
    UNASKED = "unasked"
    """Of a ticket that was not issued like this; kept, and changes nothing."""
    LOST = "lost"
    """The actor vanished; the ticket is issued again."""


@dataclass(frozen=True)
class Ack:
    """The owner has committed a trajectory to its journal."""

    id: TrajectoryId
    owner_epoch: int
    offset: int
    """Where in the journal it is."""
    verdict: Verdict
    duplicate: bool
    """It was there already; nothing was added."""

    def __post_init__(self) -> None:
        require_count("ack.offset", self.offset)
