"""`clothbus reproduce`: an experiment's missing runs, its figure and its page, by one command."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import tyro

from broker_config.errors import PresetError
from broker_config.ownership import FileLock
from deploy.reproduce.experiment import (
    AttentionFigure,
    Experiment,
    TransferTable,
    with_changes,
)
from deploy.reproduce.runs import FinishedRun, finished_runs, read_runs
from deploy.reproduce.side_by_side import finish_runs
from learner.steps.compute import Compute, TrainingPath

CURVES, SCORES, WORLDS = "curves.jsonl", "stored_states.jsonl", "worlds.jsonl"
FIGURE, ATTENTION, PAGE = "curves.png", "attention.png", "README.md"


def reproduce(
    name: Annotated[str, tyro.conf.Positional],
    /,
    panels: tuple[str, ...] = (),
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
        panels: Titles of those to run and draw; all if not given.
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
    if not isinstance(found, Experiment):
        given = [seeds, iterations, training_path, *panels, *conditions, *settings]
        is_figure = isinstance(found, AttentionFigure)
        if any(it is not None for it in given) or device != "cpu" or (is_figure and jobs != 1):
            taken = "--output and --work" if is_figure else "--output, --work, --jobs, --draw-only"
            raise PresetError(
                f"{name}: expected only {taken}; it takes the policies that experiments have left, "
                "as it is in the catalogue; leave the others out"
            )
        if isinstance(found, AttentionFigure):
            draw_attention_figure(found, work, folder, command)
        else:
            draw_transfer_table(found, work, folder, command, jobs, draw_only=draw_only)
        return
    experiment = with_changes(found, seeds, settings, conditions, panels)
    if draw_only:
        runs = finished_runs(list(experiment.plans()), folder / CURVES, iterations)
        draw(experiment, runs, folder, command, work / name)
        return
    compute = Compute(device, training_path)
    with FileLock(work / name / "reproduce.lock", f"experiment in {work / name}"):
        runs = _make_runs(experiment, folder, work / name, compute, jobs, iterations)
        draw(experiment, runs, folder, command, work / name)


def _make_runs(
    experiment: Experiment,
    folder: Path,
    work: Path,
    compute: Compute,
    jobs: int,
    iterations: int | None,
) -> list[FinishedRun]:
    """Makes what the folder does not hold yet of an experiment's runs, and of their scores."""
    # Imported here: an episode is played there, and the command line needs no simulator.
    from deploy.reproduce.repeats import runs_to_repeat
    from deploy.reproduce.stored_scores import read_scores, score_last_policies

    curves, scores = folder / CURVES, folder / SCORES
    plans = list(experiment.plans())
    sys.stderr.write(f"{experiment.name}: {len(plans)} runs in all, {compute}, {jobs} at a time\n")
    anew = runs_to_repeat(experiment, read_runs(curves), read_scores(scores), work)
    runs = finish_runs(plans, curves, work, compute, jobs, iterations, anew)
    score_last_policies(experiment, runs, scores, work, jobs)
    return runs


def draw(
    experiment: Experiment,
    runs: list[FinishedRun],
    folder: Path,
    command: str,
    work: Path = Path(),
) -> None:
    """Draws the figures and writes the page of the runs that are finished, and of their scores.

    Args:
        experiment: What was compared.
        runs: That are finished.
        folder: Of the figures and the page.
        command: That made all this.
        work: Where the runs have kept their weights; only maps of rewards need them.

    Raises:
        StorageError: A figure needs weights that are not there.
    """
    # Imported here: the runs themselves need no matplotlib.
    from deploy.reproduce.curves_figure import draw_curves
    from deploy.reproduce.page import write_page
    from deploy.reproduce.panel_runs import sort_runs
    from deploy.reproduce.reward_map_section import map_rewards
    from deploy.reproduce.stored_scores import read_scores

    folder.mkdir(parents=True, exist_ok=True)
    panels = sort_runs(experiment, runs, read_scores(folder / SCORES))
    draw_curves(folder / FIGURE, experiment.measures, panels)
    sections = map_rewards(experiment, runs, work, folder) if experiment.has_reward_maps else []
    write_page(folder / PAGE, experiment, panels, command, FIGURE, sections)
    sys.stderr.write(f"{folder / PAGE}: {len(runs)} runs\n")


def draw_attention_figure(figure: AttentionFigure, work: Path, folder: Path, command: str) -> None:
    """Draws what the policies look at that an experiment has left.

    Raises:
        StorageError: It has left none.
    """
    from deploy.attention import draw_attention
    from deploy.reproduce.attention_figure import (
        attended_rows,
        seeds_with_policies,
        write_attention_page,
    )
    from deploy.reproduce.catalogue import find_experiment

    folder.mkdir(parents=True, exist_ok=True)
    experiment = find_experiment(figure.experiment)
    # Where none has left all, the first says what is missing.
    seeds = seeds_with_policies(figure, experiment, work) or [experiment.panels[0].first_seed]
    rows_of_seeds = {seed: attended_rows(figure, experiment, work, seed) for seed in seeds}
    draw_attention(folder / ATTENTION, figure.title, rows_of_seeds[seeds[0]])
    write_attention_page(folder / PAGE, figure, command, ATTENTION, rows_of_seeds)
    sys.stderr.write(f"{folder / PAGE}: policies of {len(seeds)} seeds\n")


def draw_transfer_table(
    transfer: TransferTable, work: Path, folder: Path, command: str, jobs: int, *, draw_only: bool
) -> None:
    """Tests policies in worlds that they have not learned in, as far as they are there.

    Raises:
        ClothbusError: A trial has failed.
        StorageError: There is nothing to show.
    """
    from deploy.reproduce.transfer import score_worlds
    from deploy.reproduce.transfer_page import write_transfer_page

    folder.mkdir(parents=True, exist_ok=True)
    scores = score_worlds(transfer, folder / WORLDS, work, jobs, draw_only=draw_only)
    write_transfer_page(folder / PAGE, transfer, command, scores)
    sys.stderr.write(f"{folder / PAGE}: {len(scores)} scores\n")
