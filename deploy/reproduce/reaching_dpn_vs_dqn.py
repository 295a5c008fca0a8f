"""DPN against DQN on reaching: the literal preset, paired seeds, greedy evaluation.

    python -m deploy.reproduce.reaching_dpn_vs_dqn --jobs 2

All methods collect equally many samples and make equally many gradient steps, with the same memory,
network trunk and optimiser and from the same seeds; only the teaching signal, the way of acting and
(for the dueling variants) the head differ. An interrupted run goes on from its last iteration, and
finished runs are not repeated.
"""

from __future__ import annotations

import logging
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from broker_config.errors import ClothbusError
from deploy.reproduce.comparison import (
    Device,
    FinishedRun,
    Method,
    RunKey,
    finish_runs,
    method_preset,
)

CURVES, FIGURE, TABLE = "curves.jsonl", "curves.png", "README.md"


@dataclass(frozen=True)
class Arguments:
    """Which runs are made, on what, and where their results go."""

    methods: tuple[Method, ...] = ("dpn", "dqn")
    """The first is compared with each of the others."""
    seeds: int = 5
    """Seeds 0, 1, ... are given to every method."""
    preset: str = "reaching-ch3"
    """Name of a file in deploy/presets."""
    override: tuple[str, ...] = ()
    """Settings that replace the preset's, for example schedule.epochs=4."""
    iterations: int | None = None
    """How far the runs are followed; the preset's if None. They go on when it is more next time."""
    device: Device = "cpu"
    """What the learners compute on; actors act on the CPU."""
    jobs: int = 1
    """Runs at a time, each in a process of its own with one thread."""
    output: Path = Path("docs/reaching_dpn_vs_dqn")
    """Folder of the numbers, the figure and the table."""
    work: Path = Path("runs/reaching_dpn_vs_dqn")
    """Folder of the checkpoints; may be removed afterwards."""
    report: bool = True
    """Whether to draw the figure and write the table, which needs matplotlib."""


def reproduce(arguments: Arguments, command: str) -> list[FinishedRun]:
    """Makes the runs that are missing, then the report; returns all runs.

    Args:
        arguments: See there.
        command: What the report says it was made by.
    """
    # Seed by seed: what is finished first can be compared first.
    presets = {
        RunKey(method, seed, preset.digest): preset
        for seed in range(arguments.seeds)
        for method in arguments.methods
        for preset in (method_preset(arguments.preset, arguments.override, method, seed),)
    }
    curves = arguments.output / CURVES
    planned = min(preset.schedule.iterations for preset in presets.values())
    runs = finish_runs(
        presets,
        curves,
        arguments.work,
        arguments.device,
        arguments.jobs,
        min(planned, arguments.iterations or planned),
    )
    if arguments.report:
        _report(arguments, runs, command)
    return runs


def _report(arguments: Arguments, runs: list[FinishedRun], command: str) -> None:
    # Imported here: the runs themselves need no matplotlib.
    from deploy.reproduce.comparison_report import Comparison, draw_figure, write_table

    comparison = Comparison(
        runs={
            method: [run for run in runs if run.key.method == method]
            for method in arguments.methods
        },
        presets={
            method: method_preset(arguments.preset, arguments.override, method, 0)
            for method in arguments.methods
        },
    )
    draw_figure(arguments.output / FIGURE, comparison)
    write_table(arguments.output / TABLE, comparison, command, FIGURE)


def main() -> None:
    """The command line."""
    import tyro  # here, so that the workers do not need it

    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    arguments = tyro.cli(Arguments, description=__doc__)
    command = shlex.join(["python", "-m", "deploy.reproduce.reaching_dpn_vs_dqn", *sys.argv[1:]])
    try:
        reproduce(arguments, command)
    except ClothbusError as error:
        sys.exit(f"{error}")


if __name__ == "__main__":
    main()
