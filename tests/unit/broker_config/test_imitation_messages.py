"""Announcements and rewards refuse to exist when they are wrong."""

from dataclasses import replace

import numpy as np
import pytest

from broker_config.errors import MessageError
from broker_config.messages import (
    IterationAnnounced,
    Rewards,
    TrajectoryId,
    generated_digest,
    weights_digest,
)

IDS = (TrajectoryId("a", "i", 0), TrajectoryId("a", "i", 1))
ANNOUNCED = IterationAnnounced(0, generated_digest(IDS, 5), 5, IDS)
REWARDS = Rewards(
    discriminator="discriminator",
    incarnation="i",
    iteration=0,
    digest=ANNOUNCED.digest,
    rewards=np.zeros(5, np.float32),
    expert_version=1,
    target_version=None,
    state=b"state",
    state_digest=weights_digest(b"state"),
    numbers={},
)


def test_the_digest_names_the_samples_and_their_order():
    digests = {
        ANNOUNCED.digest,
        generated_digest(IDS, 6),
        generated_digest(IDS[::-1], 5),
        generated_digest(IDS[:1], 5),
    }
    assert len(digests) == 4


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"samples": 6}, r"digest: expected [0-9a-f]{64} \(of trajectories\)"),
        ({"trajectories": IDS[:1]}, "of trajectories"),
        ({"trajectories": ()}, "at least one of each of 0; got 5"),
        ({"samples": 1}, "at least one of each of 2; got 1"),
        ({"iteration": -1}, "a count of 0 or more"),
    ],
)
def test_an_announcement_is_of_what_it_names(change, rule):
    with pytest.raises(MessageError, match=rule):
        replace(ANNOUNCED, **change)


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"rewards": np.full(5, np.nan, np.float32)}, "expected finite numbers"),
        ({"rewards": np.zeros(5)}, "expected float32"),
        ({"expert_version": None}, "one or both versions"),
        ({"target_version": -1}, "target_version: expected a count"),
        ({"state": b"another"}, r"state_digest: expected [0-9a-f]{64} \(of state\)"),
        ({"digest": "none"}, "64 hexadecimal digits"),
        ({"discriminator": "D E"}, "rewards.discriminator: expected 1 to 64"),
    ],
)
def test_rewards_name_their_samples_and_versions(change, rule):
    with pytest.raises(MessageError, match=rule):
        replace(REWARDS, **change)


def test_rewards_are_the_same_whoever_gave_them():
    assert REWARDS.is_same_as(replace(REWARDS, discriminator="another", incarnation="j"))
    assert not REWARDS.is_same_as(replace(REWARDS, rewards=np.ones(5, np.float32)))
    assert not REWARDS.is_same_as(replace(REWARDS, iteration=1))
    other = replace(REWARDS, state=b"other", state_digest=weights_digest(b"other"))
    assert not REWARDS.is_same_as(other)
