"""Rewards are taken for what was announced, once, and never for anything else."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from broker_config.codec import encode
from broker_config.errors import MessageError, StorageError
from broker_config.journal import Journal
from broker_config.messages import (
    IterationAnnounced,
    Rewards,
    RewardsAck,
    TrajectoryId,
    weights_digest,
)
from deploy.presets import load_preset
from learner.generated import GeneratedSamples
from learner.owner import Owner

IDS = [TrajectoryId("a", "i", number) for number in range(5)]


@pytest.fixture
def owner(tmp_path: Path) -> Iterator[Owner]:
    with Journal(tmp_path / "journal.sqlite") as journal:
        yield Owner("run", load_preset("imitation-smoke"), journal)


def announced_of(iteration: int, n: int = 2) -> IterationAnnounced:
    generated = GeneratedSamples(100)
    for id_ in IDS[:n]:
        generated.add(id_, 3)
    return generated.announce(iteration)


def rewards_for(announced: IterationAnnounced, value: float = 1.0) -> Rewards:
    return Rewards(
        discriminator="discriminator",
        incarnation="life",
        iteration=announced.iteration,
        digest=announced.digest,
        rewards=np.full(announced.samples, value, np.float32),
        expert_version=announced.iteration + 1,
        target_version=None,
        state=b"state",
        state_digest=weights_digest(b"state"),
        numbers={},
    )


def give(owner: Owner, rewards: Rewards) -> RewardsAck:
    return owner.receive_rewards(rewards, encode(rewards)).result(10)


def test_rewards_are_acked_once_they_are_in_the_journal_and_again_when_resent(
    owner: Owner,
) -> None:
    announced = announced_of(0)
    owner.reward_desk.announce(announced)
    owner.reward_desk.announce(announced)
    assert owner.wait_rewards(announced, 0.0) is None
    rewards = rewards_for(announced)
    first = give(owner, rewards)
    assert (first.iteration, first.owner_epoch, first.duplicate) == (0, 1, False)
    again = give(owner, replace(rewards, incarnation="next-life"))
    assert (again.offset, again.duplicate) == (first.offset, True)
    kept = owner.wait_rewards(announced, 0.0)
    assert kept is not None
    assert kept.is_same_as(rewards)
    assert kept.incarnation == "life"


def test_other_rewards_than_those_that_were_given_are_refused(owner: Owner) -> None:
    announced = announced_of(0)
    owner.reward_desk.announce(announced)
    give(owner, rewards_for(announced))
    with pytest.raises(MessageError, match="expected those that it was given by discriminator"):
        give(owner, rewards_for(announced, value=2.0))
    kept = owner.wait_rewards(announced, 0.0)
    assert kept is not None
    assert kept.rewards[0] == 1.0


def test_rewards_of_what_was_not_announced_are_refused(owner: Owner) -> None:
    with pytest.raises(MessageError, match="rewards of iteration 0: expected D_G none"):
        give(owner, rewards_for(announced_of(0)))
    owner.reward_desk.announce(announced_of(0))
    with pytest.raises(MessageError, match="rewards of iteration 1: expected D_G none"):
        give(owner, rewards_for(announced_of(1)))
    with pytest.raises(MessageError, match=f"expected D_G {announced_of(0).digest}"):
        give(owner, rewards_for(announced_of(0, n=3)))
    few = replace(rewards_for(announced_of(0)), rewards=np.zeros(5, np.float32))
    with pytest.raises(MessageError, match="expected 6, one for each sample; got 5"):
        give(owner, few)
    assert owner.wait_rewards(announced_of(0), 0.0) is None


def test_an_iteration_is_announced_with_one_memory_only(owner: Owner) -> None:
    owner.reward_desk.announce(announced_of(0))
    with pytest.raises(MessageError, match="as it was announced; got"):
        owner.reward_desk.announce(announced_of(0, n=3))
    give(owner, rewards_for(announced_of(0)))
    with pytest.raises(MessageError, match="expected those of D_G"):
        owner.wait_rewards(announced_of(0, n=3), 0.0)


def test_a_restarted_owner_knows_what_was_given(tmp_path: Path) -> None:
    preset, announced = load_preset("imitation-smoke"), announced_of(0)
    with Journal(tmp_path / "journal.sqlite") as journal:
        owner = Owner("run", preset, journal)
        owner.reward_desk.announce(announced)
        give(owner, rewards_for(announced))
    with Journal(tmp_path / "journal.sqlite") as journal:
        owner = Owner("run", preset, journal)
        owner.reward_desk.announce(announced)
        kept = owner.wait_rewards(announced, 0.0)
        assert kept is not None
        assert give(owner, rewards_for(announced)).duplicate


@pytest.mark.parametrize("capacity", [1, 3, 4, 7, 100])
def test_the_announced_samples_are_those_of_the_memory(capacity: int) -> None:
    generated = GeneratedSamples(capacity)
    owners: list[TrajectoryId] = []
    for id_, steps in zip(IDS, (3, 1, 4, 2, 3), strict=True):
        generated.add(id_, steps)
        owners = [*owners, *[id_] * steps][-capacity:]
        announced = generated.announce(0)
        assert announced.trajectories == tuple(dict.fromkeys(owners))
        assert announced.samples == len(generated) == len(owners)
        restored = GeneratedSamples(capacity)
        restored.restore(generated.to_plain())
        assert restored.announce(0) == announced


def test_a_run_that_is_over_takes_no_rewards(owner: Owner) -> None:
    announced = announced_of(0)
    owner.reward_desk.announce(announced)
    end_offset = owner.close_record()
    rewards = rewards_for(announced)
    with pytest.raises(StorageError, match="expected a run that goes on; got one that is over"):
        owner.receive_rewards(rewards, encode(rewards))
    assert owner.close_record() == end_offset
