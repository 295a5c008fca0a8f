"""Runs with demonstrations: what they learn from, and that they go on where they were stopped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from actors.policy import Policy
from broker_config.errors import PresetError, StorageError
from broker_config.messages import Trajectory
from deploy.demonstrations.making import LEAST_TARGETS
from deploy.reproduce.chapter3 import DPN, SUPERVISED
from deploy.reproduce.chapter4 import (
    BID,
    CLONING,
    CLONING_AUGMENTED,
    PGAIL,
    PRETRAINED_BID,
    QGAIL,
    SQIL,
)
from deploy.reproduce.demonstrations import demonstrations_of
from deploy.reproduce.experiment import Condition, PolicyUnderTraining, with_changes
from deploy.reproduce.in_process_run import InProcessRun
from deploy.reproduce.page import write_page
from deploy.reproduce.panel_runs import sort_runs
from deploy.reproduce.runs import read_runs
from deploy.reproduce.side_by_side import finish_runs
from deploy.reproduce.work_folder import checkpoints_folder, policy_file
from discriminator.real_states import real_states
from learner.cloning import clone, cloning_preset
from learner.steps.compute import Compute
from learner.teaching_signal import epsilon_greedy_value, soft_value
from tests.unit.deploy.reproduce.short_experiments import (
    IMITATION,
    INITIALISED,
    SMOKE,
    smoke_plan,
    without_time,
)

torch.set_num_threads(1)  # as the runs' own processes have


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


LEARNING = ("algorithm.method=dpn", "algorithm.sigma=0.0")
TAUGHT = replace(
    IMITATION,
    panels=(replace(IMITATION.panels[0], demonstrator=PolicyUnderTraining(1, LEARNING)),),
    overrides=(*IMITATION.overrides, "imitation.target_reward=-2.0"),
)


def test_a_policy_under_training_demonstrates_the_same_to_all_conditions(tmp_path: Path) -> None:
    plans = [TAUGHT.plan(TAUGHT.panels[0], condition, 0) for condition in (BID, CLONING)]
    learned = plans[0].demonstrator
    assert learned is not None
    assert learned == plans[1].demonstrator
    with pytest.raises(StorageError, match=f"expected the last policy of {learned.key.name}; got"):
        demonstrations_of(plans[0], tmp_path)

    (cloned,) = finish_runs([plans[1]], tmp_path / "curves.jsonl", tmp_path, Compute(), 1, None)
    of_demonstrator, of_clone = sorted(
        read_runs(tmp_path / "curves.jsonl"), key=lambda run: run.key != learned.key
    )
    assert (of_demonstrator.key, of_demonstrator.iterations) == (learned.key, 1)
    assert of_clone.key == cloned.key == plans[1].key
    mine, theirs = (demonstrations_of(plan, tmp_path) for plan in plans)
    assert [it.actions.tolist() for it in mine] == [it.actions.tolist() for it in theirs]
    assert {it.ticket.policy_version for it in mine} == {1}
    whole = [it.return_ for it in mine if it.steps == 30]
    assert cloned.demonstrated_return == pytest.approx(np.mean(whole))

    page = tmp_path / "README.md"
    experiment = replace(TAUGHT, panels=(replace(TAUGHT.panels[0], conditions=(CLONING,)),))
    write_page(page, experiment, sort_runs(experiment, [cloned]), "clothbus", "curves.png")
    said = page.read_text()
    assert f"Demonstrations: mean return {np.mean(whole):.2f}" in said
    assert "1 the best that beam search finds" in said
    assert "demonstrates after 1 updates" in said
    assert "the task's script" not in said


def test_a_demonstrator_whose_policy_is_not_here_learns_again(tmp_path: Path) -> None:
    plan = TAUGHT.plan(TAUGHT.panels[0], CLONING, 0)
    assert plan.demonstrator is not None
    curves, made = tmp_path / "curves.jsonl", []
    for work in (tmp_path / "here", tmp_path / "elsewhere"):
        finish_runs([plan], curves, work, Compute(), 1, None, anew={plan.key})
        made.append(policy_file(work, plan.demonstrator).read_bytes())
    assert made[0] == made[1]
    assert len(read_runs(curves)) == 2

    # By another path it would be another demonstrator; who needs it not is made all the same.
    by_script = IMITATION.plan(IMITATION.panels[0], CLONING, 0)
    reference = Compute(path="reference")
    with pytest.raises(StorageError, match=rf"{plan.demonstrator.key.name}: expected to go on by"):
        finish_runs([plan, by_script], curves, tmp_path, reference, 1, None, anew={plan.key})
    assert by_script.key in {run.key for run in read_runs(curves)}
    assert not policy_file(tmp_path, plan).exists()


def test_a_demonstrator_whose_curve_was_not_written_before_a_kill_is_told_of(
    tmp_path: Path,
) -> None:
    plan = TAUGHT.plan(TAUGHT.panels[0], CLONING, 0)
    assert plan.demonstrator is not None
    with InProcessRun(plan.demonstrator, tmp_path) as learned:
        list(learned.finish())
        learned.keep_policy()
    finish_runs([plan], tmp_path / "curves.jsonl", tmp_path, Compute(), 1, None)
    runs = {run.key: run for run in read_runs(tmp_path / "curves.jsonl")}
    assert list(runs[plan.demonstrator.key].points) == learned.points
    assert not checkpoints_folder(tmp_path, plan.demonstrator.key).exists()
