"""The live evaluator as a process of a run: killed, stopped and ended. 30 s on two cores."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from broker_config.failpoints import FAILPOINT_VARIABLE, Failpoint
from deploy.evaluation.evaluate import evaluate
from deploy.evaluation.scores import Mode, read_results, scores_of
from deploy.process import TERMINATED_EXIT
from deploy.run_folder import RunFolder, prepare_run_folder
from tests.process.conftest import (
    Start,
    the_run,
    trajectories,
    wait_for_file,
    wait_for_trajectories,
)

EPISODES = 6
LAST_VERSION = 20
RUN_SECS = 300.0


def wait_for_results(folder: RunFolder, more: int) -> None:
    """Waits until the evaluator has written some more lines."""
    wanted = len(read_results(folder.evaluation)) + more
    deadline_secs = time.monotonic() + 120
    while len(read_results(folder.evaluation)) < wanted:
        assert time.monotonic() < deadline_secs, f"waited for {wanted} results"
        time.sleep(0.02)


def evaluator_pid(folder: RunFolder) -> int:
    """Of the process that holds the results; also when the learner has left already."""
    _, pid, *_ = folder.evaluation.with_suffix(".lock").read_text().split()
    return int(pid)


@pytest.mark.timeout(500)
def test_an_evaluator_killed_at_any_moment_scores_each_episode_once(
    start: Start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    wait_until: Callable[..., None],
) -> None:
    points = {Failpoint.EVALUATION_PLAYED: 2, Failpoint.EVALUATION_WRITTEN: 3}
    flags = {point: tmp_path / f"{point}.flag" for point in points}
    armed = ";".join(f"{point}:{count}:{flags[point]}" for point, count in points.items())
    monkeypatch.setenv(FAILPOINT_VARIABLE, armed)
    run = start(
        "run",
        *("run", "reaching-smoke", "--runs", tmp_path / "runs", "--actors", 2),
        *(
            "--evaluate",
            EPISODES,
            "--evaluator-priority",
            "normal",
            "--set",
            f"schedule.iterations={LAST_VERSION // 2}",
        ),
    )
    folder = RunFolder(the_run(tmp_path / "runs", run))
    for flag in flags.values():
        wait_until(flag.exists, f"{flag.name} is spent", timeout_secs=120)
    wait_for_results(folder, 1)
    os.kill(evaluator_pid(folder), signal.SIGKILL)
    wait_for_results(folder, 2)
    stopped = evaluator_pid(folder)
    os.kill(stopped, signal.SIGSTOP)
    goes_on = min(LAST_VERSION, trajectories(folder.path) + 3)
    wait_for_trajectories(folder.path, goes_on)  # nobody waits for a stopped evaluator
    os.kill(stopped, signal.SIGCONT)
    assert run.wait(RUN_SECS) == 0, run.log.read_text()[-3000:]

    results = read_results(folder.evaluation)
    assert max(Counter(it.key for it in results).values()) == 1
    of_last = Counter(it.mode for it in results if it.version == LAST_VERSION)
    assert of_last == {"sampled": EPISODES, "greedy": EPISODES}
    summary = folder.summary.read_text()
    assert f"version {LAST_VERSION}, sampled, {EPISODES} episodes: return " in summary
    assert_offline_agrees(folder, tmp_path / "afterwards")


def assert_offline_agrees(folder: RunFolder, elsewhere: Path) -> None:
    """`clothbus evaluate` gives the same episodes for everything that was scored live."""
    preset = folder.read_preset()
    afterwards = prepare_run_folder(elsewhere, preset)
    shutil.copytree(folder.snapshots, afterwards.snapshots)
    live = {(it.version, it.mode): it for it in scores_of(read_results(folder.evaluation), 0)}
    modes: tuple[Mode, ...] = ("sampled", "greedy")
    for mode in modes:
        versions = [it.version for it in live.values() if it.mode == mode]
        for score in evaluate(afterwards, versions, EPISODES, mode, jobs=1):
            theirs = live[score.version, mode].returns
            if len(theirs) == EPISODES:
                assert score.returns == theirs
            else:  # given up for a newer version: a killed evaluator's file has no holes either
                assert score.returns[: len(theirs)] == theirs


@pytest.mark.timeout(200)
def test_an_evaluator_that_is_terminated_says_that_it_has_not_finished(
    start: Start, tmp_path: Path
) -> None:
    router = start("router", "router", "--address-file", tmp_path / "address")
    address = wait_for_file(tmp_path / "address", router)
    output = tmp_path / "output"
    evaluator = start(
        "evaluator",
        *("evaluator", "--run", output.name, "--connect", address, "--output", output),
        *("--episodes", 100_000, "--priority", "normal"),
    )
    start("learner", "learner", output, "--preset", "reaching-smoke", "--connect", address)
    wait_for_results(RunFolder(output), 2)
    evaluator.process.terminate()
    assert evaluator.wait(60) == TERMINATED_EXIT, evaluator.log.read_text()[-3000:]
    for line in (output / "evaluation.jsonl").read_text().splitlines():
        assert json.loads(line)["version"] == 0
