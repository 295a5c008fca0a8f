"""Whole runs as a person starts them: same weights however they are carried out, clean ends."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from broker_config.journal import JOURNAL_FILE
from deploy.commands.status import read_status
from tests.process.accounting import settle
from tests.process.conftest import (
    Start,
    heartbeat_pid,
    the_run,
    trajectories,
    undisturbed_weights,
    wait_for_trajectories,
    weights,
)

FIVE_DOF = ("task.options.n_joints=5", "task.n_actions=25", "schedule.iterations=3")
"""5-DOF reaching, small: six episodes and as many updates."""

RUN_SECS = 150.0


def arguments(runs: Path, *options: object) -> list[object]:
    settings = [*FIVE_DOF, *(option for option in options if "=" in str(option))]
    others = [option for option in options if "=" not in str(option)]
    return ["run", "reaching-smoke", "--runs", runs, *others, "--set", *settings]


@pytest.mark.timeout(400)
def test_weights_are_the_same_in_one_process_and_with_one_or_four_actors(
    start: Start, tmp_path: Path
) -> None:
    results = set()
    for name, options in {
        "in-process": ["--in-process"],
        "one": ["--actors", 1],
        "four": ["--actors", 4],
    }.items():
        command = start(name, *arguments(tmp_path / name, *options))
        assert command.wait(RUN_SECS) == 0, command.log.read_text()[-3000:]
        results.add(weights(the_run(tmp_path / name, command)))
    assert len(results) == 1


@pytest.mark.timeout(400)
def test_kill_9_of_an_actor_and_of_the_learner_loses_and_doubles_nothing(
    start: Start, tmp_path: Path
) -> None:
    step_log = tmp_path / "steps.jsonl"
    run = start(
        "run",
        *arguments(
            tmp_path / "run", "--actors", 2, "--step-log", step_log, "schedule.iterations=8"
        ),
    )
    folder = the_run(tmp_path / "run", run)
    wait_for_trajectories(folder, 2)
    os.kill(heartbeat_pid(folder, "actor-0"), signal.SIGKILL)
    wait_for_trajectories(folder, 4)
    os.kill(heartbeat_pid(folder, "learner"), signal.SIGKILL)
    wait_for_trajectories(folder, 6)
    os.kill(heartbeat_pid(folder, "actor-1"), signal.SIGKILL)
    expected = undisturbed_weights(tmp_path / "undisturbed", *FIVE_DOF, "schedule.iterations=8")
    assert run.wait(RUN_SECS) == 0, run.log.read_text()[-3000:]

    account = settle(step_log, folder / JOURNAL_FILE)
    assert account.acted == account.journalled + account.cut_off
    assert set(account.accepted.values()) == {10}
    assert len(account.accepted) == 16
    assert weights(folder) == expected


@pytest.mark.timeout(300)
def test_ctrl_c_ends_everything_and_the_run_can_be_resumed(start: Start, tmp_path: Path) -> None:
    run = start("run", *arguments(tmp_path / "run", "--actors", 2, "schedule.iterations=200"))
    folder = the_run(tmp_path / "run", run)
    wait_for_trajectories(folder, 3)
    pids = [heartbeat_pid(folder, name) for name in ("actor-0", "actor-1", "learner")]
    run.process.send_signal(signal.SIGINT)
    assert run.wait(60) == 130, run.log.read_text()[-3000:]
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    assert "Stopped: reaching-smoke" in (folder / "summary.txt").read_text()
    for name in ("preset.json", "journal.sqlite", "learning_curve.png", "film_strip.png"):
        assert (folder / name).stat().st_size > 0
    before = len(list((folder / "snapshots").iterdir()))
    played = trajectories(folder)
    resumed = start("resumed", "run", "--resume", folder, "--in-process")
    wait_for_trajectories(folder, played + 5)
    resumed.process.send_signal(signal.SIGINT)
    assert resumed.wait(60) == 130, resumed.log.read_text()[-3000:]
    assert before >= 1


@pytest.mark.timeout(200)
def test_control_status_of_a_hung_process_and_a_killed_supervisor(
    start: Start, tmp_path: Path, wait_until
) -> None:
    run = start("run", *arguments(tmp_path / "run", "--actors", 1, "schedule.iterations=200"))
    folder = the_run(tmp_path / "run", run)
    wait_for_trajectories(folder, 1)
    pids = [heartbeat_pid(folder, name) for name in ("actor-0", "learner")]
    address = (folder / "router.address").read_text().strip()
    for command, state in {"pause": "paused", "resume": "running"}.items():
        control = start(command, "control", command, "--connect", folder)
        assert control.wait(60) == 0
        assert f"{folder.name}: {state}" in control.log.read_text()
    os.kill(pids[0], signal.SIGSTOP)

    def is_told_apart() -> bool:
        states = {it.id: it.heartbeat for it in read_status(address, folder.name)}
        learner = states["learner"]  # on a busy machine it may be silent too, for a moment
        assert states["actor-0"] is None
        return learner is not None and learner.numbers["policy_version"] >= 1

    wait_until(is_told_apart, "the learner is heard, and the stopped actor is not")
    os.kill(pids[0], signal.SIGCONT)
    run.kill()

    def all_gone() -> bool:
        return not any(Path(f"/proc/{pid}").exists() for pid in pids)

    wait_until(all_gone, "the supervisor's processes are gone", timeout_secs=30)
