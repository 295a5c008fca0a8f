"""What a live evaluator costs the actors: their rate without and with it, in turn, in one run.

    make bench

Two actors that never wait, on all that the machine has left; an evaluator that always has something
to play. Prints transitions per second of each window, and the ratio of neighbours: at idle priority
it is 1 but for noise; at normal priority the evaluator takes its share. About five minutes.
"""

from __future__ import annotations

import signal
import sqlite3
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from deploy.evaluation.scores import read_results
from deploy.presets import load_preset
from deploy.priority import Priority
from deploy.run_folder import RunFolder, prepare_run_folder
from deploy.running.launch import Supervisor
from deploy.running.topology import (
    actor_process,
    evaluator_process,
    learner_process,
    router_process,
)

HORIZON = 50
SETTINGS = (
    "task.options.n_joints=5",
    "task.n_actions=25",
    f"task.horizon={HORIZON}",
    "schedule.update_every='iteration'",
    "schedule.episodes_per_iteration=100000",  # the learner only takes in
    "schedule.memory_samples=1000",
)
ACTORS = 2
WINDOW_SECS = 5.0
ROUNDS = 8
START_SECS = 200.0


def transitions(folder: RunFolder) -> int:
    """Journalled so far."""
    journal = sqlite3.connect(f"file:{folder.journal}?mode=ro", uri=True)
    query = "select count(*) from entries where name like 'trajectory/%'"
    (episodes,) = journal.execute(query).fetchone()
    journal.close()
    return HORIZON * int(episodes)


def per_sec(count: Callable[[], int]) -> float:
    """Over one window."""
    before, began_secs = count(), time.monotonic()
    time.sleep(WINDOW_SECS)  # the window itself
    return (count() - before) / (time.monotonic() - began_secs)


@pytest.mark.timeout(600)
@pytest.mark.parametrize("priority", ["idle", "normal"])
def test_actors_without_and_with_an_evaluator(
    tmp_path: Path, priority: Priority, wait_until: Callable[..., None]
) -> None:
    preset = load_preset("reaching-smoke", SETTINGS)
    folder = prepare_run_folder(tmp_path / "run", preset)

    def evaluated() -> int:
        return HORIZON * len(read_results(folder.evaluation))

    # As `clothbus run` starts them: each in a session of its own, as the kernel shares time.
    with Supervisor(tmp_path / "logs") as supervisor:
        supervisor.start(router_process(folder.router_address))
        wait_until(folder.router_address.exists, "the router listens", START_SECS)
        address = folder.router_address.read_text().strip()
        supervisor.start(learner_process(folder.path, address))
        evaluator = supervisor.start(
            evaluator_process(folder.run, folder.path, 100_000, address, priority)
        )
        wait_until(evaluated, "the evaluator plays", START_SECS)
        for number in range(ACTORS):
            spool = folder.spool(f"actor-{number}")
            supervisor.start(actor_process(folder.run, f"actor-{number}", spool, address))
        wait_until(lambda: transitions(folder) > 4 * ACTORS * HORIZON, "actors act", START_SECS)

        assert evaluator.process is not None
        rates: dict[str, list[float]] = {"without": [], "with": []}
        for _ in range(ROUNDS):
            for name, order in (("without", signal.SIGSTOP), ("with", signal.SIGCONT)):
                evaluator.process.send_signal(order)
                before = evaluated()
                rates[name].append(per_sec(lambda: transitions(folder)))
                print(
                    f"{name} an evaluator at {priority} priority: actors {rates[name][-1]:.0f} "
                    f"transitions/s, evaluator {(evaluated() - before) / WINDOW_SECS:.0f}"
                )
    ratios = [
        with_it / without for with_it, without in zip(rates["with"], rates["without"], strict=True)
    ]
    print(
        f"{priority} priority, with / without: median {statistics.median(ratios):.3f} of {ROUNDS} "
        f"({min(ratios):.3f} to {max(ratios):.3f})"
    )
