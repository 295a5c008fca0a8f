"""Runs as real processes, which tests kill."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from actors.task import make_task_env
from broker_config.errors import BusError, StorageError
from broker_config.journal import JOURNAL_FILE, Journal, JournalReader
from deploy.commands.status import ProcessStatus, only_run, read_status
from deploy.presets import load_preset
from deploy.running.in_process import InProcessActor
from learner.checkpoint import CheckpointStore
from learner.learning import LearningLoop
from learner.owner import Owner
from learner.snapshots import SnapshotStore
from learner.trainer import Trainer

START_SECS = 120.0


class Command:
    """A clothbus command in a process of its own; its output is kept for failures."""

    def __init__(self, log: Path, *arguments: str) -> None:
        self.log = log
        with log.open("ab") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "deploy.cli", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )

    def wait(self, timeout_secs: float) -> int:
        """Waits for its end; returns its exit code."""
        try:
            return self.process.wait(timeout_secs)
        except subprocess.TimeoutExpired:
            pytest.fail(f"still runs after {timeout_secs} s:\n{self.log.read_text()[-3000:]}")

    def kill(self) -> None:
        """As a crash would."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def close(self) -> None:
        """Ends it in order, or by force."""
        if self.process.poll() is None:
            self.process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(20)
            if self.process.poll() is None:
                self.kill()


Start = Callable[..., Command]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Starts clothbus commands, and ends them with the test."""
    with contextlib.ExitStack() as stack:

        def start_one(name: str, *arguments: object) -> Command:
            command = Command(tmp_path / f"{name}.log", *map(str, arguments))
            stack.callback(command.close)
            return command

        yield start_one


def wait_for_file(path: Path, command: Command) -> str:
    """Waits until a file has content."""
    deadline = time.monotonic() + START_SECS
    while not (path.is_file() and path.read_text().strip()):
        assert command.process.poll() is None, command.log.read_text()[-3000:]
        assert time.monotonic() < deadline, f"waited {START_SECS} s for {path}"
        time.sleep(0.02)
    return path.read_text().strip()


def wait_for_lines(path: Path, count: int) -> None:
    """Waits until a log has so many lines."""
    deadline = time.monotonic() + START_SECS
    while not path.exists() or path.read_bytes().count(b"\n") < count:
        assert time.monotonic() < deadline, f"waited for {count} lines in {path}"
        time.sleep(0.002)


def wait_for_trajectories(folder: Path, count: int, timeout_secs: float = 120.0) -> None:
    """Waits until the journal holds so many trajectories."""
    deadline = time.monotonic() + timeout_secs
    while trajectories(folder) < count:
        assert time.monotonic() < deadline, f"{trajectories(folder)} of {count} trajectories"
        time.sleep(0.02)


def trajectories(folder: Path) -> int:
    """How many trajectories the journal of a run folder holds."""
    try:
        with JournalReader(folder / JOURNAL_FILE) as journal:
            return len(journal.entries(prefix="ended/"))
    except StorageError:
        return 0  # the learner has not made it yet


def the_run(runs: Path, command: Command) -> Path:
    """The one folder that a run has made."""
    deadline = time.monotonic() + START_SECS
    while not (folders := [it for it in runs.glob("*") if (it / "preset.json").exists()]):
        assert command.process.poll() is None, command.log.read_text()[-3000:]
        assert time.monotonic() < deadline, "no run folder"
        time.sleep(0.02)
    (folder,) = folders
    return folder


def heartbeat_pid(folder: Path, process_id: str) -> int:
    """The process id that a process of a run states in its heartbeat."""
    address = (folder / "router.address").read_text().strip()
    deadline = time.monotonic() + START_SECS
    while True:
        for status in _status(address):
            if status.id == process_id and status.heartbeat is not None:
                return status.heartbeat.pid
        assert time.monotonic() < deadline, f"no heartbeat of {process_id}"
        time.sleep(0.05)


def _status(address: str) -> list[ProcessStatus]:
    try:
        return read_status(address, only_run(address))
    except BusError:
        return []


def weights(folder: Path) -> bytes:
    """The newest policy of a run."""
    return max((folder / "snapshots").glob("*.safetensors")).read_bytes()


def undisturbed_weights(folder: Path, *settings: str) -> bytes:
    """The policy with which a run of the smoke preset ends when nothing happens to it.

    It is played in this process, which has imported everything. That `clothbus run --in-process`
    and runs over the bus come to the same, `test_runs.py` holds.
    """
    preset = load_preset("reaching-smoke", settings)
    folder.mkdir()
    with Journal(folder / JOURNAL_FILE) as journal, closing(make_task_env(preset.task)) as env:
        owner = Owner("undisturbed", preset, journal)
        snapshots = SnapshotStore(folder / "snapshots")
        loop = LearningLoop(
            owner,
            Trainer(preset),
            CheckpointStore(folder / "checkpoints"),
            snapshots,
            None,
            InProcessActor(owner, env, snapshots).play_until_ready,
        )
        for _ in loop:
            pass
    return weights(folder)
