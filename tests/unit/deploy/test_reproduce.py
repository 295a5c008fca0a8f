"""Experiments: runs that go on where they were stopped, and pages that say what came out."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from actors.policy import Policy
from broker_config.errors import AlreadyOwned, PresetError, StorageError
from broker_config.messages import Trajectory
from broker_config.ownership import FileLock
from broker_config.preset import Preset
from deploy.demonstrations.making import LEAST_TARGETS
from deploy.presets import preset_names
from deploy.reproduce import command
from deploy.reproduce.catalogue import EXPERIMENTS, find
from deploy.reproduce.chapter3 import DPN, DQN, DUELING_DPN, SUPERVISED
from deploy.reproduce.chapter4 import (
    BID,
    CLONING,
    CLONING_AUGMENTED,
    PGAIL,
    PRETRAINED_BID,
    QGAIL,
    SQIL,
)
from deploy.reproduce.command import CURVES, FIGURE, PAGE, draw
from deploy.reproduce.demonstrations import demonstrations_of
from deploy.reproduce.experiment import Condition, Experiment, Panel, with_changes
from deploy.reproduce.in_process_run import InProcessRun
from deploy.reproduce.runs import (
    CurvePoint,
    FinishedRun,
    RunPlan,
    checkpoints_folder,
    finish_runs,
    finished_runs,
    read_runs,
    write_runs,
)
from deploy.reproduce.work_folder import policy_file
from discriminator.real_states import real_states
from learner.cloning import clone, cloning_preset
from learner.steps.compute import ON_CPU, Compute
from learner.teaching_signal import epsilon_greedy_value, soft_value

torch.set_num_threads(1)  # as the runs' own processes have

INITIALISED = replace(DUELING_DPN, name="dueling-dpn-init", start="initialised")
SMOKE = Experiment(
    name="smoke",
    title="A short experiment",
    source="figure 0",
    published="It works.",
    preset="reaching-smoke",
    panels=(Panel("2 joints", (DPN, DQN, INITIALISED, SUPERVISED), seeds=2),),
    overrides=("initialisation.demonstration_samples=15", "initialisation.target_switches=2"),
    measures=("greedy_returns", "greedy_successes", "relative_bellman_errors"),
    mistake_rate=0.25,
)


IMITATION = Experiment(
    name="imitation",
    title="A short imitation",
    source="figure 0",
    published="It imitates.",
    preset="reaching-ch4-horizon30",
    panels=(Panel("2 joints", (BID, QGAIL, CLONING), seeds=1, mistake_rate=0.1),),
    overrides=(
        "task.options.n_joints=2",
        "task.n_actions=10",
        "schedule.iterations=2",
        "schedule.episodes_per_iteration=2",
        "schedule.target_switches=2",
        "imitation.demonstration_samples=40",
        "imitation.discriminator.minibatch_size=16",
        "imitation.generator_epochs=2",
        "schedule.epochs=1",
        "imitation.target_reward=-0.5",
    ),
)


def smoke_plan(condition: Condition = DPN, seed: int = 0) -> RunPlan:
    return SMOKE.plan(SMOKE.panels[0], condition, seed)


def without_time(points: list[CurvePoint]) -> list[CurvePoint]:
    return [replace(point, secs=0.0) for point in points]


def run_of(condition: Condition, seed: int, returns: list[float]) -> FinishedRun:
    points = tuple(
        CurvePoint(i, 20 * i, 5, (20 * i,), (value,), (0.5,), value, 0.1, 0.2, 0.3, 0.4, 1.5)
        for i, value in enumerate(returns)
    )
    return FinishedRun(smoke_plan(condition, seed).key, "reference steps on cpu", points)


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


def test_conditions_get_equal_samples_and_gradient_steps(tmp_path: Path) -> None:
    budgets = set()
    for condition in (DPN, DQN, DUELING_DPN):
        with InProcessRun(smoke_plan(condition), tmp_path) as run:
            last = list(run.finish())[-1]
        budgets.add((last.samples, last.gradient_steps))
    assert budgets == {(40, 20)}


def test_demonstrations_are_the_same_for_all_conditions_of_a_seed(tmp_path: Path) -> None:
    def demonstrations(condition: Condition, seed: int) -> list[Trajectory]:
        return demonstrations_of(smoke_plan(condition, seed), tmp_path)

    mine, theirs = demonstrations(INITIALISED, 0), demonstrations(SUPERVISED, 0)
    assert sum(each.steps for each in mine) == 15  # a last trajectory is cut to fit
    assert [it.actions.tolist() for it in mine] == [it.actions.tolist() for it in theirs]
    other = demonstrations(INITIALISED, 1)
    assert [it.actions.tolist() for it in other] != [it.actions.tolist() for it in mine]
    assert demonstrations(DPN, 0) == []


def test_a_cloned_policy_does_what_was_demonstrated(tmp_path: Path) -> None:
    """Without mistakes, and with enough epochs, in nearly all demonstrated states."""
    experiment = replace(SMOKE, mistake_rate=0.0)
    experiment = with_changes(experiment, 1, ["schedule.epochs=60", "optimiser.name=adam"])
    plan = experiment.plan(SMOKE.panels[0], SUPERVISED, 0)
    with InProcessRun(plan, tmp_path) as run:
        (point,) = run.finish(0)
        run.keep_policy()
    demonstrations = demonstrations_of(plan, tmp_path)
    assert (point.iteration, point.samples) == (0, 0)
    assert point.gradient_steps == 60 * 2
    weights = policy_file(tmp_path, plan).read_bytes()
    policy = Policy.from_bytes(cloning_preset(plan.preset).network, weights)
    agrees = [
        policy.greedy(picture) == action
        for each in demonstrations
        for picture, action in zip(each.observations, each.actions, strict=False)
    ]
    assert np.mean(agrees) > 0.8


IMITATORS = (BID, PRETRAINED_BID, QGAIL, SQIL, CLONING, CLONING_AUGMENTED)


@pytest.mark.parametrize("condition", IMITATORS, ids=lambda it: it.name)
def test_an_interrupted_imitation_goes_on_as_if_it_had_not_been(
    tmp_path: Path, condition: Condition
) -> None:
    plan = IMITATION.plan(IMITATION.panels[0], condition, 0)
    assert plan.key.mistake_rate == 0.1
    last = 0 if condition in (CLONING, CLONING_AUGMENTED) else 2
    with InProcessRun(plan, tmp_path / "whole") as whole:
        list(whole.finish(last))
        expected = whole.keep_policy().read_bytes()
    with InProcessRun(plan, tmp_path / "parts") as interrupted:
        next(interrupted.finish(last))
        next(interrupted.finish(last), None)
    with InProcessRun(plan, tmp_path / "parts") as resumed:
        list(resumed.finish(last))
        assert resumed.keep_policy().read_bytes() == expected
    assert without_time(resumed.points) == without_time(whole.points)


def test_imitation_learns_from_the_discriminators_rewards_alone(tmp_path: Path) -> None:
    plan = IMITATION.plan(IMITATION.panels[0], BID, 0)
    with InProcessRun(plan, tmp_path) as run:
        list(run.finish(1))
        memory, discriminators = run._trainer.memory, run._discriminators
        assert discriminators is not None
        rewards = discriminators.rewards(memory.states_after())
    assert torch.equal(memory.samples.rewards, rewards)
    assert len(rewards) == 60


@pytest.mark.parametrize("discriminators", ["expert", "target", "both"])
@pytest.mark.parametrize("generator", ["edpn", "dqn"])
def test_two_switches_make_every_variant(
    tmp_path: Path, generator: str, discriminators: str
) -> None:
    """And a fixed horizon tells nothing: the last step of an episode is worth what follows it."""
    overrides = [f"algorithm.method={generator}", f"imitation.discriminators={discriminators}"]
    overrides += ["algorithm.sigma=0.0"] if generator == "dqn" else []
    condition = Condition("variant", "variant", "C0", tuple(overrides))
    plan = IMITATION.plan(IMITATION.panels[0], condition, 0)
    with InProcessRun(plan, tmp_path) as run:
        list(run.finish(1))
        assert run._discriminators is not None
        wanted = ("expert", "target") if discriminators == "both" else (discriminators,)
        assert run._discriminators.names == wanted
        memory, learned = run._trainer.memory, run._trainer._assess()
        assert not memory.samples.terminated.any()
        assert len(memory) == 2 * plan.preset.task.horizon  # no episode was shorter
        after = run._trainer._network(memory.states_after()).detach()
    algorithm = plan.preset.algorithm
    if generator == "dqn":
        epsilon = run._trainer._epsilon()
        values = epsilon_greedy_value(after, epsilon)
    else:
        values = soft_value(after, algorithm.beta)
    expected = memory.samples.rewards + algorithm.gamma * values
    torch.testing.assert_close(learned.bellman_targets, expected, atol=1e-4, rtol=1e-4)


def test_sqil_has_the_same_demonstrations_and_as_many_gradient_steps(tmp_path: Path) -> None:
    steps = {}
    for condition in (PGAIL, SQIL):
        plan = IMITATION.plan(IMITATION.panels[0], condition, 0)
        with InProcessRun(plan, tmp_path) as run:
            steps[condition.name] = list(run.finish())[-1].gradient_steps
            memory = run._trainer.memory
    assert steps["sqil"] == steps["pgail"]
    demonstrations = demonstrations_of(IMITATION.plan(IMITATION.panels[0], BID, 0), tmp_path)
    assert memory.n_held == sum(each.steps for each in demonstrations) == 40
    held = memory.minibatch(torch.arange(40))
    assert held.actions.tolist() == np.concatenate([it.actions for it in demonstrations]).tolist()
    own = len(memory) - 40
    assert memory.samples.rewards.tolist() == [1.0] * 40 + [0.0] * own


def test_augmentation_is_that_of_discriminators(tmp_path: Path) -> None:
    """Without a table of theirs nothing says how pictures are changed."""
    augmented = replace(SUPERVISED, name="augmented", start="cloned-augmented")
    with (
        InProcessRun(smoke_plan(augmented), tmp_path) as run,
        pytest.raises(PresetError, match=r"expected an \[imitation\] table, whose"),
    ):
        next(run.finish(0))


def test_a_pretrained_generator_begins_as_a_clone_and_is_trained_further(tmp_path: Path) -> None:
    plan = IMITATION.plan(IMITATION.panels[0], PRETRAINED_BID, 0)
    epochs = plan.preset.imitation.generator_epochs
    cloned = clone(plan.preset, demonstrations_of(plan, tmp_path), epochs)
    with InProcessRun(plan, tmp_path) as run:
        begun = next(run.finish(1))
        weights = run._trainer.weights()
        (trained,) = run.finish(1)
        trained_weights = run._trainer.weights()
    assert all(torch.equal(weights[name], part) for name, part in cloned.weights.items())
    assert (begun.loss, begun.gradient_steps) == (cloned.loss, cloned.gradient_steps)
    assert trained.gradient_steps > begun.gradient_steps
    assert any(not torch.equal(trained_weights[name], part) for name, part in weights.items())


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
    with pytest.raises(StorageError, match=r"go on by winograd steps on cpu.*got reference steps"):
        InProcessRun(smoke_plan(), tmp_path, Compute(path="reference"))


def test_a_condition_may_say_by_which_path_it_learns(tmp_path: Path) -> None:
    told = replace(DPN, path="reference")
    plans = [smoke_plan(told, 0), smoke_plan(DPN, 1)]
    asked = Compute(path="winograd")
    finish_runs(plans, tmp_path / "c.jsonl", tmp_path / "work", asked, 1, iterations=1)
    assert [run.compute for run in read_runs(tmp_path / "c.jsonl")] == [
        "reference steps on cpu",
        "winograd steps on cpu",
    ]


def test_demonstrations_to_imitate_show_enough_targets(tmp_path: Path) -> None:
    """Those that do not are drawn anew; all conditions get the same."""
    few = with_changes(IMITATION, 3, ["imitation.target_reward=-0.12"])
    for seed in range(3):
        plans = [few.plan(few.panels[0], condition, seed) for condition in (BID, CLONING)]
        mine, theirs = (demonstrations_of(plan, tmp_path) for plan in plans)
        assert len(real_states(mine, -0.12)["target"]) >= LEAST_TARGETS
        assert [it.actions.tolist() for it in mine] == [it.actions.tolist() for it in theirs]
    never = with_changes(IMITATION, 1, ["imitation.target_reward=0.0"])
    with pytest.raises(StorageError, match="expected at least 3 target states"):
        demonstrations_of(never.plan(never.panels[0], BID, 0), tmp_path)


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


def test_a_policy_lag_is_refused(tmp_path: Path) -> None:
    experiment = with_changes(SMOKE, None, ["schedule.policy_lag=1"])
    with pytest.raises(ValueError, match=r"expected schedule\.policy_lag 0; got 1"):
        InProcessRun(experiment.plan(SMOKE.panels[0], DPN, 0), tmp_path)


def test_every_experiment_of_the_catalogue_can_be_planned() -> None:
    for experiment in EXPERIMENTS.values():
        assert experiment.preset in preset_names()
        plans = list(experiment.plans())
        names = {plan.key.name for plan in plans}
        assert len(names) == len(plans), experiment.name
        for plan in plans:
            assert isinstance(plan.preset, Preset)
            has_demonstrations = plan.preset.initialisation or plan.preset.imitation
            assert (plan.key.mistake_rate is not None) == (has_demonstrations is not None)


def test_some_conditions_alone() -> None:
    chosen = with_changes(SMOKE, conditions=["dqn"])
    assert [plan.key.condition for plan in chosen.plans()] == ["dqn", "dqn"]
    assert {it.key for it in chosen.plans()} < {it.key for it in SMOKE.plans()}
    with pytest.raises(PresetError, match=r"expected conditions of dpn, dqn.*got sarsa"):
        with_changes(SMOKE, conditions=["sarsa"])


def test_a_run_of_two_panels_is_made_once() -> None:
    shown_again = replace(SMOKE, panels=(*SMOKE.panels, replace(SMOKE.panels[0], title="again")))
    assert list(shown_again.plans()) == list(SMOKE.plans())


def test_a_panel_may_have_other_seeds() -> None:
    (panel,) = SMOKE.panels
    later = replace(SMOKE, panels=(replace(panel, first_seed=100),))
    assert {plan.key.seed for plan in later.plans()} == {100 + it for it in range(panel.seeds)}


def test_some_panels_alone() -> None:
    other = replace(SMOKE.panels[0], title="other", overrides=("algorithm.gamma=0.5",))
    both = replace(SMOKE, panels=(*SMOKE.panels, other))
    chosen = with_changes(both, panels=["other"])
    assert {it.key for it in chosen.plans()} == {it.key for it in both.plans()} - {
        it.key for it in SMOKE.plans()
    }
    with pytest.raises(PresetError, match=r"expected panels of .*other.*got another"):
        with_changes(both, panels=["another"])
    few = replace(both, panels=(*SMOKE.panels, replace(other, conditions=other.conditions[:1])))
    with pytest.raises(PresetError, match="got none of dqn in other"):
        with_changes(few, conditions=["dqn"], panels=["other"])


def test_there_must_be_such_an_experiment() -> None:
    with pytest.raises(PresetError, match=r"expected one of dpn-vs-dqn.*got nothing"):
        find("nothing")


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


def test_each_method_has_the_same_budget_on_seeds_that_are_not_reported() -> None:
    tuning = EXPERIMENTS["tuning-5-joints"]
    tried = [
        {(plan.key.preset_digest, plan.key.seed) for plan in replace(tuning, panels=(it,)).plans()}
        for it in tuning.panels
    ]
    assert [len(runs) for runs in tried] == [16] * 4
    reported = {seed for panel in EXPERIMENTS["figure-3.5"].panels for seed in panel.seed_numbers}
    assert not reported & {seed for panel in tuning.panels for seed in panel.seed_numbers}
