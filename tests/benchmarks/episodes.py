"""The episodes of the delivery benchmark: 650 KB that nothing can compress."""

from __future__ import annotations

import numpy as np

from broker_config.codec import encode
from broker_config.messages import Ticket, Trajectory, TrajectoryId

ACTORS = 2
STEPS = 30
PICTURE = (84, 84, 3)


def make_episode(number: int, ticket: Ticket, id_: TrajectoryId) -> Trajectory:
    """Random pictures, which nothing can compress."""
    generator = np.random.default_rng(number)
    return Trajectory(
        id=id_,
        ticket=ticket,
        observations=generator.integers(0, 256, (STEPS + 1, *PICTURE), np.uint8),
        actions=generator.integers(0, 36, STEPS, np.int32),
        rewards=generator.random(STEPS, np.float32),
        terminated=False,
        truncated=True,
        success=False,
        guard=None,
        interrupted=False,
        ended_unix_secs=1.5,
    )


def episode_bytes() -> bytes:
    """One encoded episode, for those who only carry it."""
    return encode(make_episode(0, Ticket(0, 0, 0, 0, 0, STEPS, 0.0), TrajectoryId("a", "b", 0)))
