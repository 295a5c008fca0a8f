"""Imitation over the bus: the same weights as in one process, whoever is killed, and clear waiting.

About 60 s in all on two cores: each kill costs the start of a process.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from broker_config.codec import decode
from broker_config.failpoints import Failpoint
from broker_config.journal import JOURNAL_FILE, JournalReader
from broker_config.messages import IterationAnnounced, Rewards
from deploy.commands.status import read_status
from tests.process.conftest import Start, the_run, wait_for_file, weights
from tests.process.test_failpoints import arm, fired

RUN_SECS = 300.0
ITERATIONS = 4

EVERY_WAY = (
    "algorithm.ends_at_horizon=true",
    "augmentation.turn_deg=10.0",
    "augmentation.shift_px=2",
)
"""Of learning from what is collected: their random numbers survive a kill, too."""

POINTS = (
    Failpoint.ANNOUNCEMENT_FOLLOWED,
    Failpoint.REWARDS_MADE,
    Failpoint.REWARDS_ACKED,
    Failpoint.DISCRIMINATORS_PUBLISHED,
    Failpoint.ITERATION_ANNOUNCED,
    Failpoint.REWARDS_RECEIVED,
    Failpoint.REWARDS_JOURNALED,
)
"""Of the discriminators, then of the learner; met in the first iteration."""
COUNTS = {**dict.fromkeys(POINTS, 1), Failpoint.POLICY_UPDATED: 2}
"""The last after the second update: what the first has drawn comes from a checkpoint then."""


@pytest.fixture
def demonstrations(start: Start, tmp_path: Path) -> Path:
    folder = tmp_path / "demonstrations"
    made = ["demos", "make", "imitation-smoke", "--output", folder, "--episodes", 3]
    command = start("demos", *made)
    assert command.wait(60) == 0, command.log.read_text()
    return folder


def rewards_in(folder: Path) -> list[Rewards]:
    with JournalReader(folder / JOURNAL_FILE) as journal:
        return [decode(entry.payload, Rewards) for entry in journal.entries("rewards/")]


@pytest.mark.timeout(500)
def test_weights_and_rewards_are_the_same_in_one_process_over_the_bus_and_after_kills(
    start: Start, tmp_path: Path, demonstrations: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = ["run", "imitation-smoke", "--demonstrations", demonstrations, "--set", *EVERY_WAY]
    alone = start("alone", *named, "--runs", tmp_path / "alone", "--in-process")
    bus = start("bus", *named, "--runs", tmp_path / "bus", "--actors", 3, "--no-record")
    arm(monkeypatch, tmp_path / "flags", COUNTS)
    killed = start("killed", *named, "--runs", tmp_path / "killed", "--actors", 1)

    folders = []
    for name, run in {"alone": alone, "bus": bus, "killed": killed}.items():
        assert run.wait(RUN_SECS) == 0, run.log.read_text()[-3000:]
        folders.append(the_run(tmp_path / name, run))
    assert fired(tmp_path / "flags") == set(COUNTS)

    assert len({weights(folder) for folder in folders}) == 1
    given = [rewards_in(folder) for folder in folders]
    assert [it.iteration for it in given[0]] == list(range(ITERATIONS))
    for others in given[1:]:
        assert [it.state_digest for it in others] == [it.state_digest for it in given[0]]
        assert all((a.rewards == b.rewards).all() for a, b in zip(others, given[0], strict=True))


@pytest.mark.timeout(300)
def test_a_learner_without_discriminators_says_so_and_goes_on_when_they_come(
    start: Start, tmp_path: Path, demonstrations: Path, wait_until: Callable[..., None]
) -> None:
    folder = tmp_path / "run"
    router = start("router", "router", "--address-file", tmp_path / "address")
    address = wait_for_file(tmp_path / "address", router)
    at = ["--connect", address]
    learner = start(
        "learner",
        *["learner", folder, "--preset", "imitation-smoke", *at],
        *["--demonstrations", demonstrations, "--set", "schedule.iterations=2"],
    )
    actor = start("actor", "actor", *at, "--run", "run", "--spool", tmp_path / "spool.sqlite")

    def said() -> str:
        found = {it.role: it.heartbeat for it in read_status(address, "run")}
        owner = found.get("owner")
        return "" if owner is None else owner.state

    wanted = (
        "waiting for rewards of iteration 0: nobody gives any, start "
        "`clothbus discriminator --run run`"
    )
    wait_until(lambda: said() == wanted, wanted, 60)
    assert wanted in learner.log.read_text()
    with JournalReader(folder / JOURNAL_FILE) as journal:
        entry = journal.find("announced/0")
        assert entry is not None
        assert decode(entry.payload, IterationAnnounced).samples == 36
        assert journal.find("snapshot/1") is None, "nothing is learned without rewards"

    discriminator = start("discriminator", "discriminator", *at)
    for command in (discriminator, learner, actor):
        assert command.wait(120) == 0, command.log.read_text()[-3000:]
    versions = [(it.expert_version, it.target_version) for it in rewards_in(folder)]
    assert versions == [(1, 1), (2, 2)]


@pytest.mark.timeout(120)
def test_an_imitating_run_without_demonstrations_or_targets_says_what_it_needs(
    start: Start, tmp_path: Path, demonstrations: Path
) -> None:
    run = ["run", "imitation-smoke", "--in-process", "--runs", tmp_path / "runs"]
    none = start("none", *run)
    few = start("few", *run, "--demonstrations", demonstrations, "--set", *TOO_NEAR)
    assert none.wait(60) == 3
    assert few.wait(60) == 3
    assert "expected 30 demonstration samples; got 0" in none.log.read_text()
    words = "expected demonstrations with a state of task reward -0.001 or more; got 3 without"
    assert words in few.log.read_text()


TOO_NEAR = ("imitation.target_reward=-0.001",)
