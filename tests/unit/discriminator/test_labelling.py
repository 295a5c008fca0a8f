"""Discriminators follow a journal: the same answers from wherever they start."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from broker_config.codec import encode
from broker_config.errors import StorageError
from broker_config.journal import Journal
from broker_config.messages import (
    AttemptEnded,
    IterationAnnounced,
    JournalEntry,
    Rewards,
    Trajectory,
    TrajectoryId,
    Verdict,
    generated_digest,
)
from discriminator.labelling import Labeller, snapshot_of, states_after
from discriminator.mirror import JournalMirror
from tests.unit.discriminator.test_trainer import preset_with

torch.set_num_threads(1)

MakeTrajectory = Callable[..., Trajectory]
PRESET = preset_with(discriminators="expert")
STEPS = 4


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    with Journal(tmp_path / "journal.sqlite") as opened:
        yield opened


@pytest.fixture
def small(make_trajectory: MakeTrajectory) -> MakeTrajectory:
    """Trajectories of small pictures: dark ones, and bright ones for demonstrations."""

    def make(sequence: int, bright: bool = False) -> Trajectory:
        made = make_trajectory(sequence, steps=STEPS)
        pictures = np.random.default_rng(sequence).integers(0, 60, (STEPS + 1, 36, 36, 3), np.uint8)
        return replace(made, observations=pictures + np.uint8(150 if bright else 0))

    return make


def append(journal: Journal, name: str, message: object) -> None:
    journal.append([(name, encode(message))]).result(10)


def deliver(journal: Journal, trajectory: Trajectory, verdict: Verdict = Verdict.ACCEPTED) -> None:
    ended = AttemptEnded(trajectory.ticket.index, 0, verdict, trajectory.id, STEPS, True, "")
    append(journal, f"trajectory/{trajectory.id}", trajectory)
    append(journal, f"ended/{trajectory.id}", ended)


def announce(journal: Journal, iteration: int, ids: Iterable[TrajectoryId], samples: int) -> None:
    named = tuple(ids)
    digest = generated_digest(named, samples)
    announced = IterationAnnounced(iteration, digest, samples, named)
    append(journal, f"announced/{iteration}", announced)


def caught_up(journal: Journal, labeller: Labeller | None = None) -> Labeller:
    labeller = labeller or Labeller(PRESET, "discriminator", "life")
    for entry in journal.read(labeller.next_offset, 1 << 30):
        labeller.take(entry)
    return labeller


def commit(journal: Journal, rewards: Rewards) -> None:
    append(journal, f"rewards/{rewards.iteration}", rewards)


@pytest.fixture
def begun(journal: Journal, small: MakeTrajectory) -> list[TrajectoryId]:
    """A journal with demonstrations and three trajectories of a policy; returns their ids."""
    for number in range(2):
        append(journal, f"demonstration/{number:06d}", small(100 + number, bright=True))
    played = [small(number) for number in range(3)]
    for each in played:
        deliver(journal, each)
    return [each.id for each in played]


def test_every_sample_gets_a_reward_and_demonstrated_looks_are_worth_more(
    journal: Journal, small: MakeTrajectory, begun: list[TrajectoryId]
) -> None:
    bright = replace(small(7, bright=True), id=TrajectoryId("a", "i", 3))
    deliver(journal, bright)
    announce(journal, 0, [*begun, bright.id], 4 * STEPS - 2)
    labeller = caught_up(journal)
    rewards = labeller.answer()
    assert rewards.rewards.shape == (4 * STEPS - 2,)
    assert rewards.rewards[-STEPS:].min() > rewards.rewards[:-STEPS].max()
    assert (rewards.expert_version, rewards.target_version) == (1, None)
    assert rewards.numbers["expert_epochs"] == 10
    assert not labeller.has_answered_all


def test_answers_are_the_same_again_after_a_restart_at_any_time(
    journal: Journal, small: MakeTrajectory, begun: list[TrajectoryId]
) -> None:
    announce(journal, 0, begun, 3 * STEPS)
    old = caught_up(journal)
    first = old.answer()
    assert old.answer().is_same_as(first), "asked again before the journal has it"
    assert caught_up(journal).answer().is_same_as(first), "killed before it was delivered"
    commit(journal, first)
    deliver(journal, late := small(3))
    announce(journal, 1, [*begun[1:], late.id], 3 * STEPS)
    second = caught_up(journal, old).answer()
    assert not second.is_same_as(first)
    assert second.expert_version == 2
    assert caught_up(journal).answer().is_same_as(second), "killed after the first"


def test_what_another_process_answered_is_gone_on_from(
    journal: Journal, begun: list[TrajectoryId]
) -> None:
    announce(journal, 0, begun, 3 * STEPS)
    mine, other = caught_up(journal), caught_up(journal)
    commit(journal, mine.answer())
    announce(journal, 1, begun, 3 * STEPS)
    assert caught_up(journal, other).answer().is_same_as(caught_up(journal, mine).answer())
    newest = mine.newest
    assert newest is not None
    assert newest.iteration == 0


def test_a_snapshot_has_the_networks_weights_alone(
    journal: Journal, begun: list[TrajectoryId]
) -> None:
    announce(journal, 0, begun, 3 * STEPS)
    rewards = caught_up(journal).answer()
    snapshot = snapshot_of(rewards)
    assert snapshot.expert_version == 1
    assert len(snapshot.weights) < len(rewards.state) / 2.5
    with pytest.raises(StorageError, match="expected the discriminators' state as safetensors"):
        snapshot_of(replace(rewards, state=b"", state_digest=EMPTY_DIGEST))


EMPTY_DIGEST = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"


def test_nothing_is_owed_before_it_is_announced_or_once_it_is_given(
    journal: Journal, begun: list[TrajectoryId]
) -> None:
    labeller = caught_up(journal)
    assert labeller.owed is None
    with pytest.raises(StorageError, match="expected iteration 0 to be announced; got none"):
        labeller.answer()
    announce(journal, 0, begun, 3 * STEPS)
    caught_up(journal, labeller)
    assert labeller.owed is not None
    commit(journal, labeller.answer())
    caught_up(journal, labeller)
    assert labeller.owed is None
    assert labeller.answered == 0


def test_a_journal_that_misses_something_is_refused(
    journal: Journal, begun: list[TrajectoryId], small: MakeTrajectory
) -> None:
    with pytest.raises(StorageError, match="expected entry 0; got 3"):
        JournalMirror().take(JournalEntry(3, "snapshot/0", b"", 0.0))
    announce(journal, 0, [*begun, TrajectoryId("a", "lost", 0)], 4 * STEPS)
    with pytest.raises(StorageError, match="expected trajectory a/lost/0 in the journal"):
        caught_up(journal).answer()
    with pytest.raises(StorageError, match="expected 5 samples; got 4 in 1 trajectories"):
        states_after([small(0)], 5)


def test_only_what_may_be_asked_about_is_kept(
    journal: Journal, begun: list[TrajectoryId], small: MakeTrajectory
) -> None:
    spare = replace(small(2), id=TrajectoryId("a", "spare", 0))
    deliver(journal, spare, Verdict.SPARE)
    deliver(journal, ahead := small(9))
    announce(journal, 0, begun[1:], 2 * STEPS)
    mirror = JournalMirror()
    for entry in journal:
        mirror.take(entry)
    announced = mirror.owed
    assert announced is not None
    assert [it.id for it in mirror.generated(announced)] == begun[1:]
    for gone in (begun[0], spare.id):
        with pytest.raises(StorageError, match="expected trajectory"):
            mirror.generated(replace(announced, **named(gone)))
    assert mirror.generated(replace(announced, **named(ahead.id)))[0].id == ahead.id


def named(id_: TrajectoryId) -> dict[str, object]:
    ids = (id_,)
    return {"trajectories": ids, "samples": 4, "digest": generated_digest(ids, 4)}
