"""Runs of an experiment: made once, kept, and gone on with where they were stopped."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from broker_config.errors import StorageError
from deploy.reproduce.chapter3 import DPN, DQN, DUELING_DPN, SUPERVISED
from deploy.reproduce.experiment import Condition, with_changes
from deploy.reproduce.in_process_run import InProcessRun
from deploy.reproduce.runs import RunPlan, read_runs, write_runs
from deploy.reproduce.side_by_side import finish_runs
from deploy.reproduce.work_folder import checkpoints_folder, policy_file
from learner.steps.compute import ON_CPU, Compute
from tests.unit.deploy.reproduce.short_experiments import (
    INITIALISED,
    SMOKE,
    run_of,
    smoke_plan,
    without_time,
)

torch.set_num_threads(1)  # as the runs' own processes have


@pytest.mark.parametrize("condition", [DPN, DQN, INITIALISED], ids=lambda it: it.name)
def test_an_interrupted_run_goes_on_as_if_it_had_not_been(
    tmp_path: Path, condition: Condition
) -> None:
    plan = smoke_plan(condition)
    with InProcessRun(plan, tmp_path / "whole") as whole:
        list(whole.finish())
    with InProcessRun(plan, tmp_path / "parts") as interrupted:
        next(interrupted.finish())
    with InProcessRun(plan, tmp_path / "parts") as resumed:
        assert [point.iteration for point in resumed.points] == [0]
        assert len(list(resumed.finish())) == plan.preset.schedule.iterations
    assert without_time(resumed.points) == without_time(whole.points)


def test_runs_of_another_setting_are_other_runs(tmp_path: Path) -> None:
    changed = with_changes(SMOKE, None, ["schedule.epochs=3"])
    other_rate = replace(SMOKE, mistake_rate=0.5)
    names = {
        experiment.plan(SMOKE.panels[0], condition, 0).key.name
        for experiment in (SMOKE, changed, other_rate)
        for condition in (INITIALISED, SUPERVISED)
    }
    assert len(names) == 6
    # An untrained policy has no demonstrations to differ by.
    untrained = {each.plan(SMOKE.panels[0], DPN, 0).key for each in (SMOKE, other_rate)}
    assert len(untrained) == 1


def test_what_is_finished_is_not_run_again_and_goes_on_when_more_is_asked_for(
    tmp_path: Path,
) -> None:
    plans, curves = [smoke_plan()], tmp_path / "curves.jsonl"
    (first,) = finish_runs(plans, curves, tmp_path / "work", ON_CPU, 1, iterations=1)
    (second,) = finish_runs(plans, curves, tmp_path / "work", ON_CPU, 1, iterations=None)
    assert (first.iterations, second.iterations) == (1, 2)
    assert second.points[:2] == first.points
    (again,) = finish_runs(plans, curves, tmp_path / "nowhere", ON_CPU, 1, iterations=1)
    assert again == first
    assert not (tmp_path / "nowhere" / "checkpoints").exists()


def test_a_run_that_is_scored_once_an_iteration_learns_the_same(tmp_path: Path) -> None:
    often, seldom = (
        replace(SMOKE, scored_after=each).plan(SMOKE.panels[0], DPN, 0)
        for each in ("update", "iteration")
    )
    assert often.key.name != seldom.key.name
    points = []
    for plan in (often, seldom):
        with InProcessRun(plan, tmp_path) as run:
            points.append(without_time(list(run.finish())))
    for one_of_many, alone in zip(*points, strict=True):
        assert alone == replace(
            one_of_many,
            updated_at=one_of_many.updated_at[-1:],
            greedy_returns=one_of_many.greedy_returns[-1:],
            greedy_successes=one_of_many.greedy_successes[-1:],
        )
    assert len(points[0][-1].updated_at) > 1


def test_conditions_get_equal_samples_and_gradient_steps(tmp_path: Path) -> None:
    budgets = set()
    for condition in (DPN, DQN, DUELING_DPN):
        with InProcessRun(smoke_plan(condition), tmp_path) as run:
            last = list(run.finish())[-1]
        budgets.add((last.samples, last.gradient_steps))
    assert budgets == {(40, 20)}


def test_a_run_that_fails_does_not_end_the_others(tmp_path: Path) -> None:
    good = smoke_plan()
    lagging = with_changes(SMOKE, 1, ["schedule.policy_lag=1"])
    bad = lagging.plan(SMOKE.panels[0], DPN, 0)
    curves = tmp_path / "curves.jsonl"
    with pytest.raises(ValueError, match=r"expected schedule\.policy_lag 0"):
        finish_runs([bad, good], curves, tmp_path / "work", ON_CPU, 1, iterations=1)
    (kept,) = read_runs(curves)
    assert (kept.key, kept.iterations) == (good.key, 1)
    assert checkpoints_folder(tmp_path / "work", good.key).exists()  # it may go on
    finish_runs([good], curves, tmp_path / "work", ON_CPU, 1, iterations=None)
    assert not checkpoints_folder(tmp_path / "work", good.key).exists()


def test_a_run_that_is_made_again_does_not_become_shorter(tmp_path: Path) -> None:
    plan, curves = smoke_plan(), tmp_path / "curves.jsonl"
    (whole,) = finish_runs([plan], curves, tmp_path / "here", ON_CPU, 1, iterations=None)
    arguments = (curves, tmp_path / "there", ON_CPU, 1, 1)
    (start,) = finish_runs([plan], *arguments, anew={plan.key})
    assert without_time(list(start.points)) == without_time(list(whole.points[:2]))
    (kept,) = read_runs(curves)
    assert without_time(list(kept.points)) == without_time(list(whole.points))
    assert policy_file(tmp_path / "there", plan).exists()


class EndsItsProcess(RunPlan):
    """A plan whose process is gone as soon as it reads it, as if it had been killed."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (1,)


def test_a_process_that_is_killed_is_said(tmp_path: Path) -> None:
    first, second = (smoke_plan(seed=seed) for seed in range(2))
    plans = [EndsItsProcess(first.key, first.preset), second]
    with pytest.raises(StorageError, match=r"got one that was killed.*run the command again"):
        finish_runs(plans, tmp_path / "c.jsonl", tmp_path / "work", ON_CPU, 1, iterations=1)
    finish_runs([first, second], tmp_path / "c.jsonl", tmp_path / "work", ON_CPU, 1, iterations=1)


def test_a_run_does_not_go_on_by_another_path(tmp_path: Path) -> None:
    with InProcessRun(smoke_plan(), tmp_path, Compute(path="winograd")) as begun:
        next(begun.finish())
    with pytest.raises(StorageError, match=r"go on by winograd steps .*got reference steps"):
        InProcessRun(smoke_plan(), tmp_path, Compute(path="reference"))


def test_a_condition_may_say_by_which_path_it_learns(tmp_path: Path) -> None:
    told = replace(DPN, path="reference")
    plans = [smoke_plan(told, 0), smoke_plan(DPN, 1)]
    asked = Compute(path="winograd")
    finish_runs(plans, tmp_path / "c.jsonl", tmp_path / "work", asked, 1, iterations=1)
    assert [run.compute for run in read_runs(tmp_path / "c.jsonl")] == [
        "reference steps on cpu",
        str(asked),
    ]


def test_a_policy_lag_is_refused(tmp_path: Path) -> None:
    experiment = with_changes(SMOKE, None, ["schedule.policy_lag=1"])
    with pytest.raises(ValueError, match=r"expected schedule\.policy_lag 0; got 1"):
        InProcessRun(experiment.plan(SMOKE.panels[0], DPN, 0), tmp_path)


def test_runs_survive_the_file(tmp_path: Path) -> None:
    runs = [run_of(DQN, 0, [1.0, 2.0]), run_of(DPN, 1, [3.0]), run_of(DPN, 0, [4.0])]
    path = tmp_path / "curves.jsonl"
    assert read_runs(path) == []
    write_runs(path, runs)
    assert read_runs(path) == [runs[2], runs[1], runs[0]]


def test_a_damaged_file_is_named_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "curves.jsonl"
    write_runs(path, [run_of(DPN, 0, [1.0])])
    path.write_text(path.read_text() + "{}\n")
    with pytest.raises(StorageError, match="got line 2"):
        read_runs(path)
