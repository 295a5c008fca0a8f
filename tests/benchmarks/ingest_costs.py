"""Processor time of each step that a trajectory takes in the learner, without the bus.

    python -m tests.benchmarks.ingest_costs

21 KB trajectories, a hundred actors at a time, a journal on the disk.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from broker_config.codec import decode, encode
from broker_config.journal import Journal
from broker_config.messages import Ticket, TicketRequest, Trajectory, TrajectoryId
from deploy.presets import load_preset
from learner.checkpoint import CheckpointStore
from learner.learning import LearningLoop
from learner.metrics import LearningMetrics
from learner.owner import Owner
from learner.snapshots import SnapshotStore
from learner.trainer import Trainer
from tests.benchmarks.light_actors import PICTURE, SETTINGS, STEPS
from tests.benchmarks.measuring import RESULTS, keep_result

ACTORS = 100


class Stopwatch:
    """Adds up processor time, of all threads, by the name of a step."""

    def __init__(self) -> None:
        self.secs: dict[str, float] = {}

    @contextlib.contextmanager
    def of(self, name: str) -> Iterator[None]:
        began_secs = time.process_time()
        yield
        self.secs[name] = self.secs.get(name, 0.0) + time.process_time() - began_secs


def one_round(owner: Owner, number: int, watch: Stopwatch) -> None:
    """A ticket and a trajectory for each actor."""
    tickets: list[Ticket] = []
    with watch.of("ticket issued and journalled"):
        for actor in range(ACTORS):
            request = TicketRequest(f"actor-{actor}", "life", f"n{number}")
            issued = owner.issue(request, time.monotonic())
            assert issued is not None
            reply, committed = issued
            assert reply.ticket is not None
            tickets.append(reply.ticket)
        committed.result()
    payloads = [encode(_trajectory(ticket, actor, number)) for actor, ticket in enumerate(tickets)]
    with watch.of("trajectory decoded and checked"):
        decoded = [decode(payload, Trajectory) for payload in payloads]
    with watch.of("judged, journalled, acked"):
        acks = [owner.receive(*it) for it in zip(decoded, payloads, strict=True)]
        for ack in acks:
            ack.result()


def _trajectory(ticket: Ticket, actor: int, number: int) -> Trajectory:
    pictures = np.random.default_rng(actor).integers(0, 256, (STEPS + 1, *PICTURE), np.uint8)
    return Trajectory(
        id=TrajectoryId(f"actor-{actor}", "life", number),
        ticket=ticket,
        observations=pictures,
        actions=np.zeros(STEPS, np.int32),
        rewards=np.zeros(STEPS, np.float32),
        terminated=False,
        truncated=True,
        success=False,
        guard=None,
        interrupted=False,
        ended_unix_secs=1.5,
    )


def measure(rounds: int) -> dict[str, object]:
    """Processor seconds of each step, for one trajectory."""
    torch.set_num_threads(1)
    watch, preset = Stopwatch(), load_preset("reaching-smoke", SETTINGS)
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        journal = stack.enter_context(Journal(folder / "journal.sqlite"))
        metrics = stack.enter_context(LearningMetrics(folder / "tensorboard"))
        owner = Owner("run", preset, journal)
        stores = CheckpointStore(folder / "checkpoints"), SnapshotStore(folder / "snapshots")
        events = iter(LearningLoop(owner, Trainer(preset), *stores))
        next(events)  # the untrained policy
        for number in range(rounds):
            one_round(owner, number, watch)
            with watch.of("absorbed: read, decoded, into the memory"):
                absorbed = [next(events) for _ in range(ACTORS)]
            with watch.of("its numbers logged"):
                for event in absorbed:
                    metrics.note(event)
    count = rounds * ACTORS
    return {
        "trajectories": count,
        "cpu_secs_each": {name: round(secs / count, 6) for name, secs in watch.secs.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=40, help="of a hundred trajectories")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    keep_result(arguments.out, "ingest_costs", measure(arguments.rounds))


if __name__ == "__main__":
    main()
