"""Kills between each two steps of the commit order: the run comes back by itself, to the same end.

About 60 s in all on two cores: each kill costs the start of a process.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from broker_config.failpoints import FAILPOINT_VARIABLE, Failpoint
from broker_config.journal import JOURNAL_FILE
from tests.process.accounting import settle
from tests.process.conftest import (
    Start,
    the_run,
    trajectories,
    undisturbed_weights,
    wait_for_file,
    wait_for_lines,
    wait_for_trajectories,
    weights,
)

SETTINGS = ("schedule.iterations=6", "schedule.memory_samples=20", "schedule.epochs=1")
EPISODES, HORIZON = 12, 10
RUN_SECS = 500.0

ACTOR_POINTS = (
    Failpoint.TICKET_RECEIVED,
    Failpoint.EPISODE_PLAYED,
    Failpoint.EPISODE_SPOOLED,
    Failpoint.TRAJECTORY_SENT,
    Failpoint.ACK_RECEIVED,
)
LEARNER_POINTS_WHEN_ASKED = (
    Failpoint.TRAJECTORY_RECEIVED,
    Failpoint.TRAJECTORY_JOURNALED,
    Failpoint.TICKET_JOURNALED,
    Failpoint.EPISODE_ABSORBED,
    Failpoint.POLICY_UPDATED,
)
LEARNER_POINTS_OF_ITSELF = (
    Failpoint.FILE_WRITTEN,
    Failpoint.CHECKPOINT_SAVED,
    Failpoint.SNAPSHOT_STORED,
    Failpoint.ITERATION_JOURNALED,
    Failpoint.SNAPSHOT_JOURNALED,
    Failpoint.SNAPSHOT_PUBLISHED,
)
GROUPS = {
    "actor": ACTOR_POINTS,
    "learner-when-asked": LEARNER_POINTS_WHEN_ASKED,
    "learner-of-itself": LEARNER_POINTS_OF_ITSELF,
}
CUT_OFF_AT = {Failpoint.EPISODE_PLAYED}
"""Whoever dies here has played an episode that is nowhere yet: another one plays it again."""


def arm(monkeypatch: pytest.MonkeyPatch, flags: Path, counts: Mapping[Failpoint, int]) -> None:
    """Processes that start from now on are killed at these points, once at each.

    Args:
        monkeypatch: Sets what they read.
        flags: Folder for what shows at which of them one was killed.
        counts: How often a life meets a point up to its end there. With two everywhere, each gets
            a little further than the one before.
    """
    flags.mkdir(parents=True)
    armed = ";".join(f"{point}:{count}:{flags / point}" for point, count in counts.items())
    monkeypatch.setenv(FAILPOINT_VARIABLE, armed)


def fired(flags: Path) -> set[str]:
    return {path.name for path in flags.iterdir()}


@pytest.mark.timeout(600)
def test_runs_killed_at_failpoints_end_with_the_undisturbed_weights_and_lose_nothing(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each group has a run; they share the machine's cores."""
    named = ["run", "reaching-smoke", "--set", *SETTINGS, "--runs"]
    runs = {}
    for group, points in GROUPS.items():
        folder = tmp_path / group
        arm(monkeypatch, folder / "flags", dict.fromkeys(points, 2))
        options = ["--actors", 1, "--no-record", "--step-log", folder / "steps.jsonl"]
        runs[group] = start(group, *named, folder / "runs", *options)
    expected = undisturbed_weights(tmp_path / "undisturbed", *SETTINGS)
    for group, run in runs.items():
        assert run.wait(RUN_SECS) == 0, run.log.read_text()[-3000:]
        assert fired(tmp_path / group / "flags") == set(GROUPS[group])
        folder = the_run(tmp_path / group / "runs", run)
        account = settle(tmp_path / group / "steps.jsonl", folder / JOURNAL_FILE)
        assert account.acted == account.journalled + account.cut_off
        assert account.cut_off == HORIZON * len(CUT_OFF_AT.intersection(GROUPS[group]))
        assert dict(account.accepted) == dict.fromkeys(range(EPISODES), HORIZON)
        assert weights(folder) == expected


@pytest.mark.timeout(200)
def test_a_robot_s_actor_killed_after_it_has_recovered_its_spool_delivers_the_steps_once(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flags, step_log, folder = tmp_path / "flags", tmp_path / "steps.jsonl", tmp_path / "run"
    router = start("router", "router", "--address-file", tmp_path / "address")
    address = wait_for_file(tmp_path / "address", router)
    learner = ["learner", folder, "--preset", "reaching-smoke", "--connect", address]
    owner = start("learner", *learner, "--set", "task.horizon=150", "schedule.iterations=1")
    arm(monkeypatch, flags, {Failpoint.SPOOL_RECOVERED: 1})
    actor = ["actor", "--id", "robot", "--connect", address, "--run", "run", "--spool-steps"]
    actor += ["--spool", tmp_path / "spool.sqlite", "--step-log", step_log]
    first = start("actor-1", *actor)
    wait_for_lines(step_log, 50)
    first.kill()
    assert start("actor-2", *actor).wait(60) == -9
    assert fired(flags) == {Failpoint.SPOOL_RECOVERED}
    assert trajectories(folder) == 0
    third = start("actor-3", *actor)
    wait_for_trajectories(folder, 3)
    assert third.wait(60) == 0
    assert owner.wait(60) == 0
    account = settle(step_log, folder / JOURNAL_FILE)
    assert account.acted - account.journalled == account.cut_off <= 1
    assert dict(account.accepted) == {0: 150, 1: 150}
