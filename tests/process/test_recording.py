"""Runs with a recorder that is killed: the journalled part is whole in the recording."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from broker_config.failpoints import FAILPOINT_VARIABLE, Failpoint
from broker_config.journal import JOURNAL_FILE
from broker_config.messages import View
from broker_config.recording.recording import iter_recording
from tests.process.conftest import (
    Start,
    heartbeat_pid,
    the_run,
    wait_for_file,
    wait_for_trajectories,
)
from tests.process.recorded import settle_recording

SETTINGS = ("task.options.n_joints=5", "task.n_actions=25")
RUN_SECS = 200.0


def recorder_deaths(folder: Path) -> int:
    """How often the recorder began anew."""
    return (folder / "logs" / "recorder.log").read_text().count("Recording into") - 1


@pytest.mark.timeout(400)
def test_kill_9_of_the_recorder_loses_and_doubles_nothing(start: Start, tmp_path: Path) -> None:
    run = start(
        "run",
        *["run", "reaching-smoke", "--runs", tmp_path / "runs", "--actors", 2],
        *["--set", *SETTINGS, "schedule.iterations=8"],
    )
    folder = the_run(tmp_path / "runs", run)
    for count in (2, 7):
        wait_for_trajectories(folder, count)
        os.kill(heartbeat_pid(folder, "recorder"), signal.SIGKILL)
    assert run.wait(RUN_SECS) == 0, run.log.read_text()[-3000:]

    assert recorder_deaths(folder) == 2
    account = settle_recording(folder / "recording", folder / JOURNAL_FILE)
    assert account.accepted == 16
    assert account.snapshots == 17
    assert account.segments == 3
    assert account.topics["metrics/owner/learner"] > 0
    views = [
        message
        for item in iter_recording(folder / "recording", ["view/actor-0", "view/actor-1"])
        if isinstance(message := item.decode(), View)
    ]
    assert {view.step for view in views} >= {0, 10}, "first and last of an episode"
    assert all(view.picture.startswith(b"\x89PNG") for view in views)


@pytest.mark.timeout(400)
def test_a_recorder_that_ends_at_each_of_its_failpoints_loses_nothing(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The first time, so that however fast the run is each is reached.
    points = {
        Failpoint.BATCH_RECEIVED: 1,
        Failpoint.RECORDING_RECOVERED: 1,
        Failpoint.BATCH_WRITTEN: 1,
        Failpoint.BATCH_HELD: 1,
    }
    flags = {point: tmp_path / point.value for point in points}
    armed = [f"{point}:{count}:{flags[point]}" for point, count in points.items()]
    monkeypatch.setenv(FAILPOINT_VARIABLE, ";".join(armed))
    run = start(
        "run",
        *["run", "reaching-smoke", "--runs", tmp_path / "runs"],
        *["--set", *SETTINGS, "schedule.iterations=4"],
    )
    folder = the_run(tmp_path / "runs", run)
    assert run.wait(RUN_SECS) == 0, run.log.read_text()[-3000:]
    assert [point for point, flag in flags.items() if not flag.exists()] == []
    account = settle_recording(folder / "recording", folder / JOURNAL_FILE)
    assert (account.accepted, account.snapshots) == (8, 9)
    assert not list((folder / "recording").glob("*.partial"))


@pytest.mark.timeout(400)
def test_check_finds_a_run_that_imitates_whole_though_its_recorder_was_killed_twice(
    start: Start, tmp_path: Path
) -> None:
    demonstrations = tmp_path / "demonstrations"
    arguments = ["imitation-smoke", "--output", demonstrations, "--episodes", 3]
    collected = start("demos", "demos", "make", *arguments)
    assert collected.wait(60) == 0, collected.log.read_text()
    arguments = ["imitation-smoke", "--demonstrations", demonstrations, "--actors", 3]
    run = start("run", "run", *arguments, "--runs", tmp_path / "runs")
    folder = the_run(tmp_path / "runs", run)
    for count in (2, 7):
        wait_for_trajectories(folder, count)
        os.kill(heartbeat_pid(folder, "recorder"), signal.SIGKILL)
    assert run.wait(RUN_SECS) == 0, run.log.read_text()[-3000:]

    check = start("check", "check", folder, "--against", folder)
    assert check.wait(60) == 0, check.log.read_text()
    said = check.log.read_text()
    assert said.count("began with journal entry") == 3
    assert "recording: whole; " in said
    assert "4 rewards" in said
    part = start("slice", "slice", folder, "--output", tmp_path / "part", "--iterations", "1-2")
    assert part.wait(60) == 0, part.log.read_text()
    check = start("check-part", "check", tmp_path / "part", "--against", folder)
    assert check.wait(60) == 0, check.log.read_text()
    assert "2 rewards" in check.log.read_text()


@pytest.mark.timeout(200)
def test_a_recorder_alone_says_how_it_ended(
    start: Start, tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    router = start("router", "router", "--address-file", tmp_path / "address")
    address = wait_for_file(tmp_path / "address", router)
    folder = tmp_path / "recording"
    arguments = ["record", "--run", "demo", "--connect", address, "--output", folder]
    first = start("first", *arguments)
    wait_until(lambda: "Recording into" in first.log.read_text(), "it records", 60)
    second = start("second", *arguments, "--id", "another")
    assert second.wait(60) == 3
    assert "expected no other owner; got pid" in second.log.read_text()
    first.process.send_signal(signal.SIGTERM)
    assert first.wait(60) == 143, first.log.read_text()
    assert next(item.topic for item in iter_recording(folder)) == "recorder"
    (folder / "000001.mcap").write_bytes(b"something else")
    third = start("third", *arguments)
    assert third.wait(60) == 3
    assert "expected a segment of a clothbus recording; got another" in third.log.read_text()
