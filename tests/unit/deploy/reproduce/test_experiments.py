"""Experiments as data: their plans, and parts of them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from broker_config.errors import PresetError
from broker_config.preset import Preset
from deploy.presets import preset_names
from deploy.reproduce.catalogue import EXPERIMENTS, find
from deploy.reproduce.chapter4 import BID
from deploy.reproduce.experiment import PolicyUnderTraining, with_changes
from tests.unit.deploy.reproduce.short_experiments import IMITATION, SMOKE


def test_every_experiment_of_the_catalogue_can_be_planned() -> None:
    for experiment in EXPERIMENTS.values():
        assert experiment.preset in preset_names()
        plans = list(experiment.plans())
        names = {plan.key.name for plan in plans}
        assert len(names) == len(plans), experiment.name
        for plan in plans:
            assert isinstance(plan.preset, Preset)
            has_demonstrations = plan.preset.initialisation or plan.preset.imitation
            has_demonstrator = plan.key.mistake_rate is not None or plan.demonstrator is not None
            assert has_demonstrator == (has_demonstrations is not None)


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


def test_each_method_has_the_same_budget_on_seeds_that_are_not_reported() -> None:
    tuning = EXPERIMENTS["tuning-5-joints"]
    tried = [
        {(plan.key.preset_digest, plan.key.seed) for plan in replace(tuning, panels=(it,)).plans()}
        for it in tuning.panels
    ]
    assert [len(runs) for runs in tried] == [16] * 5
    for panel in tuning.panels:
        presets = (tuning.preset_of(panel, it, panel.first_seed) for it in panel.conditions)
        schedules = (preset.schedule for preset in presets)
        assert len({each.target_switches * each.epochs for each in schedules}) == 1, panel.title
    reported = {seed for panel in EXPERIMENTS["figure-3.5"].panels for seed in panel.seed_numbers}
    assert not reported & {seed for panel in tuning.panels for seed in panel.seed_numbers}


def test_who_demonstrates_learns_as_its_panel_says_whatever_is_changed_for_the_others() -> None:
    learning = ("algorithm.method=dpn", "algorithm.sigma=0.0", "schedule.target_switches=2")
    teacher = PolicyUnderTraining(1, (*learning, "imitation.generator_epochs=2"))
    panel = replace(IMITATION.panels[0], demonstrator=teacher)
    experiment = replace(IMITATION, panels=(panel,))
    changes = ["schedule.target_switches=3", "imitation.generator_epochs=3", "algorithm.eta=2.0"]
    changed = with_changes(experiment, overrides=changes)
    plan, as_it_was = (it.plan(it.panels[0], BID, 0) for it in (changed, experiment))
    assert plan.preset.schedule.target_switches == 3
    learned, before = plan.demonstrator, as_it_was.demonstrator
    assert learned is not None
    assert before is not None
    assert learned.preset.schedule == before.preset.schedule
    assert learned.preset.schedule.iterations == 1
    assert (learned.preset.algorithm.eta, before.preset.algorithm.eta) == (2.0, 1.0)
    assert learned.preset.task == plan.preset.task
    assert {learned.preset.imitation, learned.preset.initialisation} == {None}
    assert plan.key.mistake_rate is None
    assert plan.key.demonstrator == learned.key.name != before.key.name
