"""Followers that ask and do not read, or are stopped, beside a real learner: acks do not wait.

About 15 s.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from broker_config.bus import Bus
from broker_config.heart import Pulse
from broker_config.journal import Journal
from broker_config.messages import Ack, Trajectory
from deploy.presets import load_preset
from learner.checkpoint import CheckpointStore
from learner.learning import LearningLoop
from learner.metrics import LearningMetrics
from learner.owner import Owner
from learner.service import LearnerService
from learner.snapshots import SnapshotStore
from learner.trainer import Trainer
from tests.conftest import RouterProcess

PRESET = load_preset("reaching-smoke")

FOLLOWER = """
import signal, sys
from broker_config.bus import open_bus
from broker_config.codec import encode
from broker_config.messages import JournalBatch, JournalRequest
address, run, name, reads = sys.argv[1:]
with open_bus(address, run, "recorder", name) as bus:
    key = bus.keys.journal("recorder", name)
    request = JournalRequest("recorder", name, "life", 0, 0, 32 << 20)
    print("asks", flush=True)
    while reads == "reads":
        bus.ask(key, request, JournalBatch, timeout_secs=20)
        print("read", flush=True)
    question = encode(request)
    waiting = [bus.ask_later(key, question, JournalBatch, timeout_secs=60) for _ in range(20)]
    print("asked", flush=True)
    signal.pause()
"""


@pytest.fixture
def learner(
    attach: Callable[..., Bus], run_name: str, tmp_path: Path
) -> Iterator[tuple[Owner, Journal]]:
    """A learner's service in a thread of this process; nobody plays its tickets."""
    with (
        Journal(tmp_path / "journal.sqlite") as journal,
        LearningMetrics(tmp_path / "tensorboard") as metrics,
    ):
        owner = Owner(run_name, PRESET, journal)
        snapshots = SnapshotStore(tmp_path / "snapshots")
        checkpoints = CheckpointStore(tmp_path / "checkpoints")
        loop = LearningLoop(owner, Trainer(PRESET), checkpoints, snapshots)
        bus, bulk = attach("owner", "learner"), attach("owner", "learner")
        service = LearnerService(
            bus, bulk, "learner", owner, loop, journal, snapshots, metrics, Pulse()
        )
        thread = threading.Thread(target=service.run)
        thread.start()
        yield owner, journal
        owner.followers.forget(None)
        owner.stop()
        thread.join(60)
        assert not thread.is_alive()


@contextmanager
def follower(address: str, run: str, name: str, reads: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", FOLLOWER, address, run, name, reads]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def read_until(process: subprocess.Popen[str], word: str) -> None:
    assert process.stdout is not None
    while (line := process.stdout.readline().strip()) != word:
        assert line, f"the follower ended before it said {word}"


def ack_secs(bus: Bus, make_trajectory: Callable[..., Trajectory], first: int) -> list[float]:
    """How long each of some trajectories of 70 KB takes to its ack; no ticket asked for them."""
    took = []
    for sequence in range(first, first + 30):
        made = make_trajectory(sequence, "probe", steps=10)
        gray = np.ascontiguousarray(made.observations[..., :1])
        item = Trajectory(**{**made.__dict__, "observations": gray, "actions": made.actions % 10})
        began_secs = time.monotonic()
        bus.ask(bus.keys.trajectory("probe"), item, Ack, timeout_secs=60)
        took.append(time.monotonic() - began_secs)
    return took


def test_followers_that_ask_and_do_not_read_delay_no_ack(
    learner: tuple[Owner, Journal],
    attach: Callable[..., Bus],
    router: RouterProcess,
    run_name: str,
    make_trajectory: Callable[..., Trajectory],
    wait_until: Callable[..., None],
) -> None:
    owner, journal = learner
    bus = attach("actor", "probe")
    wait_until(lambda: owner.latest_version == 0, "the learner is ready")
    for number in range(40):  # 24 MB for each follower's every question
        journal.append([(f"ballast/{number}", bytes(600_000))]).result(20)
    alone = ack_secs(bus, make_trajectory, 0)
    with (
        follower(router.address, run_name, "silent", "asks-only") as silent,
        follower(router.address, run_name, "stopped", "reads") as stopped,
    ):
        read_until(silent, "asked")
        read_until(stopped, "read")
        os.kill(stopped.pid, signal.SIGSTOP)
        os.kill(silent.pid, signal.SIGSTOP)
        beside = ack_secs(bus, make_trajectory, 100)
    measured = f"acks alone: {_quantiles(alone)}; beside the followers: {_quantiles(beside)}"
    assert np.median(beside) < 5 * np.median(alone) + 0.1, measured
    assert max(beside) < 4.0, measured  # a link that is blocked is closed after 5 s


def _quantiles(secs: list[float]) -> str:
    return f"p50 {1000 * np.median(secs):.0f} ms, longest {1000 * max(secs):.0f} ms"
