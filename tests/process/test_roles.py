"""Each role started alone, as on several machines; a robot's actor that spools every step."""

from __future__ import annotations

from pathlib import Path

import pytest

from broker_config.journal import JOURNAL_FILE
from tests.process.accounting import settle
from tests.process.conftest import (
    Start,
    trajectories,
    wait_for_file,
    wait_for_lines,
    wait_for_trajectories,
)

HORIZON = 150
SETTINGS = (
    "task.options.n_joints=5",
    "task.n_actions=25",
    f"task.horizon={HORIZON}",
    "schedule.memory_samples=20",
    "schedule.epochs=1",
    "schedule.iterations=3",
)
RUN_SECS = 150.0


@pytest.mark.timeout(400)
def test_a_robot_s_actor_killed_in_mid_episode_loses_no_finished_step(
    start: Start, tmp_path: Path
) -> None:
    folder, step_log = tmp_path / "run", tmp_path / "steps.jsonl"
    router = start("router", "router", "--address-file", tmp_path / "address")
    address = wait_for_file(tmp_path / "address", router)
    learner = ["learner", folder, "--preset", "reaching-smoke", "--connect", address]
    first_learner = start("learner", *learner, "--set", *SETTINGS)
    actor = ["actor", "--id", "robot", "--connect", address, "--run", "run", "--spool-steps"]
    actor += ["--spool", tmp_path / "spool.sqlite", "--step-log", step_log]
    kills = 0
    first_actor = start("actor", *actor)
    for steps in (HORIZON // 3, 2 * HORIZON):
        wait_for_lines(step_log, steps)
        first_actor.kill()
        kills += 1
        first_actor = start(f"actor-{kills}", *actor)
    wait_for_trajectories(folder, 4)
    first_learner.kill()
    second_learner = start("learner-again", "learner", folder, "--connect", address)
    assert second_learner.wait(RUN_SECS) == 0, second_learner.log.read_text()[-3000:]
    assert first_actor.wait(60) == 0, first_actor.log.read_text()[-3000:]

    account = settle(step_log, folder / JOURNAL_FILE)
    assert account.acted - account.journalled == account.cut_off <= kills
    assert account.learned == account.journalled
    assert dict(account.accepted) == dict.fromkeys(range(6), HORIZON)
    assert trajectories(folder) > 6, "no attempt was interrupted: the kills came between episodes"


@pytest.mark.timeout(200)
def test_refusals_name_both_values_and_end_the_process(start: Start, tmp_path: Path) -> None:
    router = start("router", "router", "--address-file", tmp_path / "address")
    address = wait_for_file(tmp_path / "address", router)
    start(
        "learner", "learner", tmp_path / "run", "--preset", "reaching-smoke", "--connect", address
    )
    wait_for_file(tmp_path / "run" / "preset.json", router)
    wait_for_trajectories(tmp_path / "run", 0)
    other = ["--preset", "reaching-smoke", "--set", "seed=1"]
    actor = start(
        "actor", "actor", "--connect", address, "--run", "run", "--spool", tmp_path / "s", *other
    )
    assert actor.wait(60) == 3
    assert "preset digest: expected" in actor.log.read_text()
    second = start("second", "learner", tmp_path / "run", "--connect", address)
    assert second.wait(60) == 3
    assert "expected no other owner; got pid" in second.log.read_text()


def test_without_a_router_or_a_run_the_command_says_what_to_do(
    start: Start, tmp_path: Path, free_port: int
) -> None:
    nobody = start("nobody", "status", "--connect", f"tcp/127.0.0.1:{free_port}")
    assert nobody.wait(60) == 4
    assert f"clothbus router --listen tcp/127.0.0.1:{free_port}" in nobody.log.read_text()
    router = start("router", "router", "--address-file", tmp_path / "address")
    address = wait_for_file(tmp_path / "address", router)
    empty = start("empty", "status", "--connect", address)
    assert empty.wait(60) == 3
    assert "expected one run; got none" in empty.log.read_text()
