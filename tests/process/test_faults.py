"""Whole runs under supervision: restarts, hung processes, drained actors, resumption, full disks.

About 90 s in all on two free cores.
"""

from __future__ import annotations

import os
import re
import resource
import signal
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from broker_config.codec import decode
from broker_config.journal import JOURNAL_FILE, JournalReader
from broker_config.messages import Trajectory
from broker_config.spool import Spool
from deploy.run_folder import RunFolder
from tests.faults.witness import children, spooled
from tests.process.accounting import settle
from tests.process.conftest import (
    Command,
    Start,
    the_run,
    trajectories,
    undisturbed_weights,
    wait_for_trajectories,
    weights,
)

SETTINGS = ("schedule.memory_samples=20", "schedule.epochs=1")
HORIZON = 10
RUN_SECS = 150.0

WaitUntil = Callable[..., None]


def settings(iterations: int) -> list[str]:
    return [*SETTINGS, f"schedule.iterations={iterations}"]


def arguments(runs: Path, iterations: int, *options: object) -> list[object]:
    return ["run", "reaching-smoke", "--runs", runs, *options, "--set", *settings(iterations)]


def pid_of(run: Command, process: str) -> int:
    return children(run.process.pid)[process].pid


def is_new(run: Command, process: str, old_pid: int) -> bool:
    found = children(run.process.pid).get(process)
    return found is not None and found.pid != old_pid


@pytest.mark.timeout(300)
def test_what_is_ended_or_hangs_is_started_again_and_who_is_drained_is_not(
    start: Start, tmp_path: Path, wait_until: WaitUntil
) -> None:
    options = ["--actors", 3, "--hung-secs", 10, "--no-record"]
    run = start("run", *arguments(tmp_path / "runs", 2000, *options))
    folder = the_run(tmp_path / "runs", run)
    wait_for_trajectories(folder, 6)

    def goes_on() -> None:
        wait_for_trajectories(folder, trajectories(folder) + 4)

    for process in ("actor-0", "learner", "router"):
        pid = pid_of(run, process)
        os.kill(pid, signal.SIGTERM)
        wait_until(lambda p=process, old=pid: is_new(run, p, old), f"a new {process}", 60)
        assert f"{process} ended with code 143; starting it again" in run.log.read_text()
        goes_on()

    drain = start("drain", "control", "drain", "--process", "actor-1", "--connect", folder)
    assert drain.wait(60) == 0
    wait_until(lambda: "actor-1" not in children(run.process.pid), "actor-1 has left", 60)
    assert spooled(folder / "spools" / "actor-1.sqlite") == []
    goes_on()
    assert "actor-1" not in children(run.process.pid), "it was started again"

    for process in ("actor-2", "router"):
        pid = pid_of(run, process)
        os.kill(pid, signal.SIGSTOP)
        wait_until(lambda p=process, old=pid: is_new(run, p, old), f"a new {process}", 60)
        assert f"{process} hangs: " in run.log.read_text()
        goes_on()

    living = [child.pid for child in children(run.process.pid).values()]
    run.process.send_signal(signal.SIGTERM)
    assert run.wait(60) == 143
    assert not any(Path(f"/proc/{pid}").exists() for pid in living)
    assert "Stopped: reaching-smoke" in (folder / "summary.txt").read_text()
    assert not (folder / "recording").exists()


@pytest.mark.timeout(300)
def test_after_kill_9_of_the_supervisor_a_run_is_resumed_at_once_and_ends_once(
    start: Start, tmp_path: Path
) -> None:
    step_log = tmp_path / "steps.jsonl"
    options = ["--actors", 2, "--step-log", step_log, "--no-record"]
    run = start("run", *arguments(tmp_path / "runs", 6, *options))
    folder = the_run(tmp_path / "runs", run)
    wait_for_trajectories(folder, 3)
    os.kill(pid_of(run, "learner"), signal.SIGSTOP)  # it cannot end with its supervisor
    stopped = pid_of(run, "learner")
    run.kill()
    resumed = start("resumed", "run", "--resume", folder, *options)
    wait_for_text(resumed, "Run folder")
    os.kill(stopped, signal.SIGCONT)  # now it does, and the new one has the journal
    assert resumed.wait(RUN_SECS) == 0, resumed.log.read_text()[-3000:]
    account = settle(step_log, folder / JOURNAL_FILE)
    assert account.acted == account.journalled + account.cut_off
    assert dict(account.accepted) == dict.fromkeys(range(12), HORIZON)
    assert weights(folder) == undisturbed_weights(tmp_path / "undisturbed", *settings(6))

    with JournalReader(folder / JOURNAL_FILE) as journal:
        end_offset = journal.end_offset
    again = start("again", "run", "--resume", folder)
    assert again.wait(60) == 0, again.log.read_text()[-3000:]
    assert "Finished: reaching-smoke" in again.log.read_text()
    with JournalReader(folder / JOURNAL_FILE) as journal:
        assert journal.end_offset == end_offset, "there was nothing left to do"
    _leave_something_in_the_spool(RunFolder(folder))
    once_more = start("once-more", "run", "--resume", folder)
    assert once_more.wait(60) == 0, once_more.log.read_text()[-3000:]
    assert spooled(folder / "spools" / "actor-0.sqlite") == []
    with JournalReader(folder / JOURNAL_FILE) as journal:
        assert journal.find("trajectory/actor-0/late/" + LATE_SEQUENCE) is not None


LATE_SEQUENCE = "1000"


def _leave_something_in_the_spool(folder: RunFolder) -> None:
    with JournalReader(folder.journal) as journal:
        payload = journal.entries(prefix="trajectory/")[0].payload
    with Spool(folder.spool("actor-0"), folder.run, "actor-0", "late", 1 << 30) as spool:
        id_ = replace(spool.next_id(), sequence=int(LATE_SEQUENCE))
        spool.put(replace(decode(payload, Trajectory), id=id_))


def wait_for_text(command: Command, text: str) -> None:
    deadline = time.monotonic() + 60
    while text not in command.log.read_text():
        assert time.monotonic() < deadline, command.log.read_text()[-3000:]
        time.sleep(0.02)


@pytest.mark.timeout(400)
def test_a_locked_journal_and_a_full_disk_end_the_run_in_words_and_lose_nothing(
    start: Start, tmp_path: Path
) -> None:
    step_log = tmp_path / "steps.jsonl"
    options = ["--actors", 2, "--step-log", step_log, "--no-record"]
    run = start("run", *arguments(tmp_path / "runs", 10, *options))
    folder = the_run(tmp_path / "runs", run)
    wait_for_trajectories(folder, 4)
    with closing(sqlite3.connect(folder / JOURNAL_FILE, isolation_level=None)) as other:
        other.execute("PRAGMA busy_timeout=20000")
        other.execute("BEGIN IMMEDIATE")
        assert run.wait(60) == 3, run.log.read_text()[-3000:]
        other.execute("ROLLBACK")
    assert "journal.sqlite: expected a working SQLite file; got database is locked" in last(run)
    assert "another process is writing it; stop that process" in last(run)

    full = start("full", "run", "--resume", folder, *options)
    before = trajectories(folder)
    wait_for_trajectories(folder, before + 2)
    wal_bytes = (folder / "journal.sqlite-wal").stat().st_size
    limits = (wal_bytes - 50_000, resource.RLIM_INFINITY)
    resource.prlimit(pid_of(full, "learner"), resource.RLIMIT_FSIZE, limits)
    assert full.wait(60) == 3, full.log.read_text()[-3000:]
    assert re.search(r"learner ended with code 3: clothbus: .*(disk|size limit)", last(full))

    resumed = start("resumed", "run", "--resume", folder, *options)
    assert resumed.wait(RUN_SECS) == 0, resumed.log.read_text()[-3000:]
    account = settle(step_log, folder / JOURNAL_FILE)
    assert account.acted == account.journalled + account.cut_off
    assert dict(account.accepted) == dict.fromkeys(range(20), HORIZON)
    assert weights(folder) == undisturbed_weights(tmp_path / "undisturbed", *settings(10))


def last(command: Command) -> str:
    return command.log.read_text().strip().splitlines()[-1]
