"""Which demonstrated states are real to whom."""

from __future__ import annotations

import numpy as np
import pytest

from broker_config.errors import MessageError
from broker_config.messages import Ticket, Trajectory, TrajectoryId
from discriminator.real_states import real_states


def demonstration(number: int, rewards: list[float], success: bool) -> Trajectory:
    """Whose picture after step k is all 10 * number + k."""
    steps = len(rewards)
    pictures = np.zeros((steps + 1, 36, 36, 1), np.uint8)
    pictures += (10 * number + np.arange(steps + 1, dtype=np.uint8))[:, None, None, None]
    return Trajectory(
        id=TrajectoryId("a", "b", number),
        ticket=Ticket(number, 0, 0, 0, 0, steps, 0.0),
        observations=pictures,
        actions=np.zeros(steps, np.int32),
        rewards=np.array(rewards, np.float32),
        terminated=False,
        truncated=True,
        success=success,
        guard=None,
        interrupted=False,
        ended_unix_secs=0.0,
    )


DEMONSTRATIONS = [
    demonstration(1, [-1.0, -0.05, -0.5], success=False),
    demonstration(2, [-0.1, -0.2], success=True),
]


def names(pictures: object) -> list[int]:
    return [int(picture.max()) for picture in pictures]  # type: ignore[attr-defined]


def test_every_state_that_was_reached_is_demonstrated() -> None:
    real = real_states(DEMONSTRATIONS, None)
    assert names(real["expert"]) == [11, 12, 13, 21, 22]
    assert real["expert"].shape == (5, 36, 36, 1)


def test_targets_are_the_last_states_of_what_succeeded() -> None:
    assert names(real_states(DEMONSTRATIONS, None)["target"]) == [22]


def test_targets_are_states_of_a_reward() -> None:
    assert names(real_states(DEMONSTRATIONS, -0.1)["target"]) == [12, 21]
    assert names(real_states(DEMONSTRATIONS, 0.0)["target"]) == []


def test_there_must_be_demonstrations() -> None:
    with pytest.raises(MessageError, match="expected demonstrations; got none"):
        real_states([], None)
