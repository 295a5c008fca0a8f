"""`clothbus reproduce`: an experiment's missing runs, its figure and its page, by one command."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import tyro

from broker_config.errors import PresetError
from deploy.reproduce.experiment import AttentionFigure, Experiment, with_changes
from deploy.reproduce.runs import FinishedRun, finish_runs, finished_runs
from learner.compute import Compute, TrainingPath

CURVES, FIGURE, ATTENTION, PAGE = "curves.jsonl", "curves.png", "attention.png", "README.md"


def reproduce(
    name: Annotated[str, tyro.conf.Positional],
    /,
    conditions: tuple[str, ...] = (),
    seeds: int | None = None,
    iterations: int | None = None,
    jobs: int = 1,
    settings: Annotated[tuple[str, ...], tyro.conf.arg(name="set")] = (),
    device: str = "cpu",
    training_path: TrainingPath | None = None,
    output: Path | None = None,
    work: Path = Path("runs/reproduce"),
    draw_only: bool = False,
) -> None:
    """Reproduce a figure of the source: run what is missing, go on with what was stopped, draw.

    Args:
        name: An experiment; an unknown name lists them.
        conditions: Names of those to run and draw; all if not given.
        seeds: Of each condition; the experiment's own number if not given.
        iterations: How far runs are followed; they go on when it is more next time.
        jobs: Runs at a time, each in a process of its own with one thread.
        settings: Settings that replace the experiment's: schedule.epochs=2.
        device: Where the learners compute: cpu, cuda.
        training_path: How gradient steps are made; chosen by the device if not given.
        output: Folder of numbers, figure and page; docs/NAME if not given.
        work: Folder of checkpoints, demonstrations and last policies.
        draw_only: Draw what is finished, and run nothing.
    """
    from deploy.reproduce.catalogue import find

    folder = Path("docs") / name if output is None else output
    told = [argument for argument in sys.argv[2:] if argument != "--draw-only"]
    command = shlex.join(["clothbus", "reproduce", *told])
    found = find(name)
    if isinstance(found, AttentionFigure):
        given = [seeds, iterations, training_path, *conditions, *settings]
        if any(each is not None for each in given):
            raise PresetError(
                f"{name}: expected only --output and --work; it draws the policies that "
                f"{found.experiment} has left, as it is in the catalogue; leave the others out"
            )
        draw_attention_figure(found, work, folder, command)
        return
    experiment = with_changes(found, seeds, settings, conditions)
    plans, curves = list(experiment.plans()), folder / CURVES
    if draw_only:
        runs = finished_runs(plans, curves, iterations)
    else:
        compute = Compute(device, training_path)
        sys.stderr.write(f"{name}: {len(plans)} runs in all, {compute}, {jobs} at a time\n")
        runs = finish_runs(plans, curves, work / name, compute, jobs, iterations)
    draw(experiment, runs, folder, command)


def draw(experiment: Experiment, runs: list[FinishedRun], folder: Path, command: str) -> None:
    """Draws the figure and writes the page of the runs that are finished."""
    # Imported here: the runs themselves need no matplotlib.
    from deploy.reproduce.report import draw_figure, sort_runs, write_page

    folder.mkdir(parents=True, exist_ok=True)
    panels = sort_runs(experiment, runs)
    draw_figure(folder / FIGURE, experiment, panels)
    write_page(folder / PAGE, experiment, panels, command, FIGURE)
    sys.stderr.write(f"{folder / PAGE}: {len(runs)} runs\n")


def draw_attention_figure(figure: AttentionFigure, work: Path, folder: Path, command: str) -> None:
    """Draws what the policies look at that an experiment has left.

    Raises:
        StorageError: It has left none.
    """
    from deploy.attention import draw_attention
    from deploy.reproduce.attention_figure import attended_rows, write_attention_page

    folder.mkdir(parents=True, exist_ok=True)
    rows = attended_rows(figure, work)
    draw_attention(folder / ATTENTION, figure.title, rows)
    write_attention_page(folder / PAGE, figure, command, ATTENTION)
    sys.stderr.write(f"{folder / PAGE}: {len(rows)} policies\n")
