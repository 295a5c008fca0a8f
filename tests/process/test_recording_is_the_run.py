"""A recording is enough to repeat its run, to learn from it anew, and to see it again.

About 90 s in all on two cores: a run whose recorder is killed, and what is made of its recording.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from broker_config.bus import open_bus
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import Metrics, View
from tests.conftest import RouterProcess
from tests.faults.witness import children
from tests.process.conftest import (
    Command,
    Start,
    the_run,
    wait_for_file,
    wait_for_trajectories,
    weights,
)

WaitUntil = Callable[..., None]
RUN_SECS = 200.0
EPISODES = 12


@pytest.fixture
def demonstrations(start: Start, tmp_path: Path) -> Path:
    folder = tmp_path / "demonstrations"
    made = ["demos", "make", "imitation-smoke", "--output", folder, "--episodes", 3]
    command = start("demos", *made)
    assert command.wait(60) == 0, command.log.read_text()
    return folder


def kill_recorder(run: Command, wait_until: WaitUntil) -> None:
    wait_until(lambda: "recorder" in children(run.process.pid), "a recorder", 60)
    old = children(run.process.pid)["recorder"].pid
    os.kill(old, signal.SIGKILL)

    def is_new() -> bool:
        found = children(run.process.pid).get("recorder")
        return found is not None and found.pid != old

    wait_until(is_new, "a new recorder", 60)


@pytest.fixture
def recording(
    start: Start, tmp_path: Path, demonstrations: Path, wait_until: WaitUntil
) -> tuple[Path, bytes]:
    """Of a run with discriminators and three actors, whose recorder died twice; and its weights."""
    run = start(
        "run",
        *["run", "imitation-smoke", "--actors", 3, "--runs", tmp_path / "runs"],
        *["--demonstrations", demonstrations],
    )
    folder = the_run(tmp_path / "runs", run)
    wait_for_trajectories(folder, 2)
    kill_recorder(run, wait_until)
    wait_for_trajectories(folder, 7)
    kill_recorder(run, wait_until)
    assert run.wait(RUN_SECS) == 0, run.log.read_text()[-3000:]
    alone = tmp_path / "recording-alone"
    (folder / "recording").rename(alone)
    return alone, weights(folder)


@pytest.mark.timeout(500)
def test_a_recording_whose_recorder_was_killed_gives_the_run_s_weights_again(
    start: Start, tmp_path: Path, recording: tuple[Path, bytes], router: RouterProcess
) -> None:
    source, expected = recording
    runs = tmp_path / "again"
    checked = start("check", "check", source)
    again = start("again", "train", "--from", source, "--runs", runs)
    live = tmp_path / "live"
    at = ["--connect", router.address]
    learner = start("learner", *learner_arguments(live, tmp_path, *at))
    wait_for_file(live / "preset.json", learner)
    discriminator = start("discriminator", "discriminator", *at, "--run", "live")
    actors = start("actors", "replay", source, "--as", "actors", *at, "--run", "live")

    assert checked.wait(RUN_SECS) == 0, checked.log.read_text()[-3000:]
    assert again.wait(RUN_SECS) == 0, again.log.read_text()[-3000:]
    assert "the weights of all 5 policy versions are the recorded ones" in again.log.read_text()
    assert weights(the_run(runs, again)) == expected
    for command in (actors, discriminator, learner):
        assert command.wait(RUN_SECS) == 0, command.log.read_text()[-3000:]
    words = "Delivered 12 trajectories of 12 recorded episodes; 0 were not taken; 0 had been played"
    assert words in actors.log.read_text()
    assert weights(live) == expected


def learner_arguments(folder: Path, tmp_path: Path, *options: object) -> list[object]:
    given = ["--demonstrations", tmp_path / "demonstrations"]
    return ["learner", folder, "--preset", "imitation-smoke", *given, *options]


@pytest.mark.timeout(500)
def test_a_recording_is_seen_again_and_its_episodes_teach_another_learner(
    start: Start, tmp_path: Path, recording: tuple[Path, bytes], router: RouterProcess
) -> None:
    source, expected = recording
    at = ["--connect", router.address]
    views: list[View] = []
    metrics: list[Metrics] = []

    def on_view(_: ParsedKey, view: View) -> None:
        views.append(view)

    def on_metrics(_: ParsedKey, numbers: Metrics) -> None:
        metrics.append(numbers)

    with open_bus(router.address, "seen-again", "observer", "viewer") as bus:
        bus.subscribe(bus.keys.every(Kind.VIEW), View, on_view)
        bus.subscribe(bus.keys.every(Kind.METRICS), Metrics, on_metrics)
        seen = start("seen", "replay", source, "--view", *at, "--run", "seen-again", "--speed", 20)
        assert seen.wait(RUN_SECS) == 0, seen.log.read_text()[-3000:]
    assert {view.actor for view in views} == {"actor-0", "actor-1", "actor-2"}
    assert {it.role for it in metrics} >= {"owner", "discriminator", "recorder"}
    assert "5 Snapshot" in seen.log.read_text()
    assert "4 JournalEntry" in seen.log.read_text(), "the rewards"

    live = tmp_path / "other"
    other = ["--set", 'algorithm.method="dpn"', "algorithm.sigma=0.0"]
    learner = start("learner", *learner_arguments(live, tmp_path, *at, *other))
    wait_for_file(live / "preset.json", learner)
    discriminator = start("discriminator", "discriminator", *at, "--run", "other")
    actors = start("actors", "replay", source, "--as", "actors", *at, "--run", "other")
    for command in (actors, discriminator, learner):
        assert command.wait(RUN_SECS) == 0, command.log.read_text()[-3000:]
    assert "0 were not taken; 12 had been played by another policy" in actors.log.read_text()
    assert weights(live) != expected
