"""What one command leaves: numbers, figure and page."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from broker_config.errors import AlreadyOwned
from broker_config.ownership import FileLock
from deploy.reproduce import command
from deploy.reproduce.chapter3 import DPN, DQN
from deploy.reproduce.command import CURVES, FIGURE, PAGE, draw
from deploy.reproduce.experiment import Panel, with_changes
from deploy.reproduce.runs import (
    FinishedRun,
    finished_runs,
    write_runs,
)
from tests.unit.deploy.reproduce.short_experiments import INITIALISED, SMOKE, run_of, smoke_plan

torch.set_num_threads(1)  # as the runs' own processes have


def test_runs_that_were_not_followed_so_far_are_not_drawn(tmp_path: Path) -> None:
    curves = tmp_path / "curves.jsonl"
    longer, shorter = run_of(DPN, 0, [1.0, 2.0, 3.0]), run_of(DPN, 1, [4.0, 5.0])
    write_runs(curves, [longer, shorter])
    plans = [smoke_plan(DPN, seed) for seed in (0, 1)]
    assert finished_runs(plans, curves, None) == [longer]
    both = finished_runs(plans, curves, 1)
    assert [run.iterations for run in both] == [1, 1]
    draw(replace(SMOKE, panels=(Panel("p", (DPN,), 2),)), both, tmp_path, "command")


def test_a_single_seed_tells_nothing_yet(tmp_path: Path) -> None:
    experiment = replace(SMOKE, panels=(Panel("2 joints", (DPN, DQN), seeds=1),))
    draw(experiment, [run_of(DPN, 0, [2.0, 2.0]), run_of(DQN, 0, [1.0, 1.0])], tmp_path, "command")
    page = (tmp_path / PAGE).read_text()
    assert "minus DQN's is +1.00, which with seeds as few as 1 tells nothing yet." in page
    assert "is above" not in page
    assert "| DPN - DQN, areas | +1.00 | +1.00 | needs two seeds | needs two seeds |" in page
    assert "| DPN | 1 | 2.00 | needs two seeds |" in page


def test_the_page_says_what_each_panel_has(tmp_path: Path) -> None:
    panels = (
        Panel("few mistakes", (INITIALISED,), 1, ("algorithm.eta=2.0",), mistake_rate=0.1),
        Panel("many mistakes", (INITIALISED,), 1, mistake_rate=0.7),
    )
    experiment = replace(SMOKE, panels=panels)
    points = run_of(DPN, 0, [1.0, 2.0]).points
    runs = [FinishedRun(experiment.plan(it, INITIALISED, 0).key, "x", points) for it in panels]
    draw(experiment, runs, tmp_path, "the command")
    page = (tmp_path / PAGE).read_text()
    assert "10% or 70% of its actions random" in page
    assert "## few mistakes\n\nHere `algorithm.eta=2.0`.\n" in page
    assert "where a condition does not say otherwise: eta 1," in page


def test_the_page_states_the_paired_difference(tmp_path: Path) -> None:
    experiment = replace(SMOKE, panels=(Panel("2 joints", (DPN, DQN), seeds=4),))
    returns = {DPN: [-2.0, -1.0, -3.0], DQN: [-4.0, -5.0, -6.0]}
    made = [
        run_of(condition, seed, [value, value])
        for condition, values in returns.items()
        for seed, value in enumerate(values)
    ]
    draw(experiment, made, tmp_path, "the command")
    page = (tmp_path / PAGE).read_text()
    assert "DPN's area under the curve is above DQN's: the mean paired difference is +3.00" in page
    assert (
        "| DPN - DQN, areas | +2.00, +4.00, +3.00 | +3.00 | +2.00 to +4.00 | +0.52 to +5.48 |"
        in page
    )
    assert "| DPN | 3 | -2.00 | -3.00 to -1.00 | 50% | 50% to 50% | -2.00 | 20 | 5 | 0.1 |" in page


def test_what_exploration_costs_counts_in_returns_while_learning_alone(tmp_path: Path) -> None:
    panel = Panel("2 joints", (DPN, DQN), seeds=4)
    experiment = replace(SMOKE, panels=(panel,), measures=("greedy_returns", "training_returns"))
    made = []
    for seed, costs in enumerate(((9.0, 3.0, 1.0), (9.0, 5.0, 1.0), (9.0, 7.0, 1.0))):
        made.append(run_of(DPN, seed, [0.0, -2.0, -4.0]))
        as_good = run_of(DQN, seed, [0.0, -2.0, -4.0])
        explores = [
            replace(point, training_return=point.training_return - cost)
            for point, cost in zip(as_good.points, costs, strict=True)
        ]
        made.append(replace(as_good, points=tuple(explores)))
    draw(experiment, made, tmp_path, "the command")
    page = (tmp_path / PAGE).read_text()
    assert "area under the curve is not told apart from DQN's" in page
    assert "DPN's mean return while learning is above DQN's: the mean paired difference is" in page
    assert "| DPN - DQN, areas | +0.00, +0.00, +0.00 |" in page
    assert "| DPN - DQN, return while learning | +2.00, +3.00, +4.00 | +3.00 |" in page


def test_of_settings_that_were_tried_the_one_with_the_largest_mean_area_is_chosen(
    tmp_path: Path,
) -> None:
    panel = Panel("settings", (DPN, DQN), seeds=2, tries_settings=True)
    experiment = replace(SMOKE, panels=(panel,))
    was_lucky = [run_of(DPN, 0, [3.0, 9.0]), run_of(DPN, 1, [-3.0, 2.0])]  # 6.0 and -0.5
    is_best = [run_of(DQN, 0, [6.0, 1.0]), run_of(DQN, 1, [6.0, 1.0])]  # 3.5 and 3.5
    draw(experiment, [*was_lucky, *is_best[:1]], tmp_path, "the command")
    assert "Nothing is chosen before all runs are finished." in (tmp_path / PAGE).read_text()
    draw(experiment, [*was_lucky, *is_best], tmp_path, "the command")
    page = (tmp_path / PAGE).read_text()
    assert "Chosen, since its mean area is the largest: **DQN**." in page
    assert "tells nothing" not in page  # settings are not compared with each other


def test_the_page_says_how_far_above_its_demonstrations_each_is(tmp_path: Path) -> None:
    experiment = replace(SMOKE, panels=(Panel("2 joints", (DPN, DQN), seeds=2),))
    made = [run_of(DPN, seed, [3.0, 4.0 + seed]) for seed in (0, 1)]
    without = run_of(DQN, 0, [3.0, 4.0])
    points = (replace(without.points[0], training_return=None), *without.points[1:])
    draw(experiment, [*made, replace(without, points=points)], tmp_path, "the command")
    page = (tmp_path / PAGE).read_text()
    assert "| DPN - its demonstrations, last return | +1.00, +2.00 | +1.50 |" in page
    assert "DQN - its demonstrations" not in page


def test_a_run_that_stood_still_counts_for_little(tmp_path: Path) -> None:
    experiment = replace(SMOKE, panels=(Panel("2 joints", (DPN,), seeds=3),))
    made = [run_of(DPN, seed, [1.0, 2.0]) for seed in range(3)]
    stopped = tuple(replace(point, secs=9000.0) for point in made[0].points)
    draw(experiment, [replace(made[0], points=stopped), *made[1:]], tmp_path, "the command")
    (row,) = (it for it in (tmp_path / PAGE).read_text().splitlines() if it.startswith("| DPN |"))
    assert row.endswith("| 0.1 |")


def test_one_command_leaves_numbers_figure_and_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from deploy.reproduce import catalogue

    monkeypatch.setitem(catalogue.EXPERIMENTS, "smoke", with_changes(SMOKE, 1, ()))
    monkeypatch.setattr(command.sys, "argv", ["clothbus", "reproduce", "smoke", "--draw-only"])
    places = {"output": tmp_path / "docs", "work": tmp_path / "work"}
    command.reproduce("smoke", jobs=2, **places)
    rows = [json.loads(line) for line in (tmp_path / "docs" / CURVES).read_text().splitlines()]
    assert len(rows) == 3 * 3 + 1  # three points of a learner, one of a clone
    assert (tmp_path / "docs" / FIGURE).stat().st_size > 5000
    page = (tmp_path / "docs" / PAGE).read_text()
    assert "clothbus reproduce smoke\n" in page
    assert "| DPN - DQN, areas |" in page
    assert "**Published** (figure 0): It works." in page
    command.reproduce("smoke", draw_only=True, **places)
    assert (tmp_path / "docs" / PAGE).read_text() == page


def test_two_commands_do_not_write_over_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from deploy.reproduce import catalogue

    monkeypatch.setitem(catalogue.EXPERIMENTS, "smoke", SMOKE)
    with (
        FileLock(tmp_path / "work" / "smoke" / "reproduce.lock", "another"),
        pytest.raises(AlreadyOwned, match="experiment in"),
    ):
        command.reproduce("smoke", output=tmp_path, work=tmp_path / "work")
