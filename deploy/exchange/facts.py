"""What is said of a trajectory beside its arrays, in every format that it is exported to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from actors.rollout import environment_seed
from broker_config.messages import Ticket, Trajectory, TrajectoryId
from deploy.exchange.source import MarkedTrajectory, Source

IMPORTED_ACTOR = "imported"
"""Of trajectories that others recorded: their tickets are made up, so their seeds say nothing."""


@dataclass(frozen=True)
class TrajectoryFacts:
    """A trajectory without its arrays and flags; with both it is the same again."""

    id: TrajectoryId
    ticket: Ticket
    success: bool
    interrupted: bool
    ended_unix_secs: float
    guard: str | None = None
    targets: tuple[int, ...] = ()
    """Which of its states a person marked as targets."""

    def with_arrays(
        self,
        observations: NDArray[np.uint8],
        actions: NDArray[np.int32],
        rewards: NDArray[np.float32],
        *,
        terminated: bool,
        truncated: bool,
    ) -> MarkedTrajectory:
        """The trajectory that these are the facts of.

        Args:
            observations: u8[T+1, H, W, C].
            actions: i32[T].
            rewards: f32[T].
            terminated: At its end.
            truncated: At its end.

        Raises:
            MessageError: They do not fit each other.
        """
        trajectory = Trajectory(
            id=self.id,
            ticket=self.ticket,
            observations=observations,
            actions=actions,
            rewards=rewards,
            terminated=terminated,
            truncated=truncated,
            success=self.success,
            guard=self.guard,
            interrupted=self.interrupted,
            ended_unix_secs=self.ended_unix_secs,
        )
        return MarkedTrajectory(trajectory, self.targets)


def facts_of(item: MarkedTrajectory) -> TrajectoryFacts:
    """What is exported beside its arrays."""
    it = item.trajectory
    return TrajectoryFacts(
        it.id, it.ticket, it.success, it.interrupted, it.ended_unix_secs, it.guard, item.targets
    )


def reset_seed(trajectory: Trajectory) -> int | None:
    """With which the environment's `reset` gives its first observation, if that is known."""
    return None if trajectory.id.actor == IMPORTED_ACTOR else environment_seed(trajectory.ticket)


def flags(at_end: bool, steps: int) -> NDArray[np.bool_]:
    """bool[T]: false before the last step."""
    array = np.zeros(steps, np.bool_)
    array[-1] = at_end
    return array


def demonstrated_by(source: Source) -> str:
    """Who or what acted."""
    if source.origin is not None:
        return str(source.origin.demonstrator)
    return f"{source.preset.algorithm.method} under training"
