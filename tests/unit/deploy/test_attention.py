"""Pictures of what policies look at."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from actors.policy import Policy
from broker_config.errors import StorageError
from deploy.attention import AttendedStep, attend, draw_attention
from deploy.presets import load_preset
from deploy.reproduce.attention_figure import attended_rows, heat_table, seeds_with_policies
from deploy.reproduce.catalogue import ATTENTION_FIGURES, EXPERIMENTS, find_experiment
from deploy.reproduce.chapter4 import ATTENTION_OF_CHAPTER_4
from deploy.reproduce.experiment import Condition, Experiment, Panel
from deploy.reproduce.work_folder import policy_file
from learner.cloning import cloning_preset
from learner.trainer import Trainer

torch.set_num_threads(1)
PRESET = load_preset("reaching-smoke")
POLICY = Condition("pgail-bid", "PGAIL-BiD", "C0", ())
OTHER = Condition("cloning", "behaviour cloning", "C1", (), start="cloned")
UNSEEN = Condition("pgail", "PGAIL", "C2", ())


def test_a_policy_is_asked_at_each_step_of_its_own_episode(tmp_path: Path) -> None:
    policy = Policy(PRESET.network, Trainer(PRESET).weights())
    attended = attend(PRESET, policy, episode=0, steps=3)
    assert len(attended) == 3
    for step in attended:
        assert step.action == policy.greedy(step.picture)
        assert (step.heat == policy.attention(step.picture, step.action)).all()
    assert len(attend(PRESET, policy, episode=0, steps=10_000)) == PRESET.task.horizon
    draw_attention(tmp_path / "attention.png", "title", [("one", attended), ("two", attended[:2])])
    assert (tmp_path / "attention.png").stat().st_size > 5000


def test_figures_are_of_policies_that_experiments_keep(tmp_path: Path) -> None:
    for figure in ATTENTION_FIGURES.values():
        experiment = EXPERIMENTS[figure.experiment]
        titles = {panel.title for panel in experiment.panels}
        known = {condition.name for it in experiment.panels for condition in it.conditions}
        assert set(figure.conditions) <= known
        assert set(figure.panels) <= titles
        with pytest.raises(StorageError, match="weights stay where they were made"):
            attended_rows(figure, experiment, tmp_path, seed=1)
        assert seeds_with_policies(figure, experiment, tmp_path) == []


def test_policies_of_several_tasks_are_told_apart(tmp_path: Path) -> None:
    """As those of shirt and trousers are in figure 4.13: here arms with two and with one joint."""
    (figure,) = ATTENTION_OF_CHAPTER_4
    titles = {panel.title for panel in find_experiment(figure.experiment).panels}
    assert set(figure.panels) <= titles
    of_chapter_4 = replace(figure, panels=())
    one_joint = ("task.options.n_joints=1", "task.n_actions=5")
    experiment = Experiment(
        name=of_chapter_4.experiment,
        title="",
        source="",
        published="",
        preset="reaching-smoke",
        panels=(
            Panel("two joints", (POLICY, OTHER, UNSEEN), seeds=1),
            Panel("one joint", (POLICY, OTHER, UNSEEN), seeds=1, overrides=one_joint),
        ),
    )
    for panel in experiment.panels:
        for condition in (POLICY, OTHER):
            plan = experiment.plan(panel, condition, 0)
            preset = cloning_preset(plan.preset) if plan.key.start == "cloned" else plan.preset
            path = policy_file(tmp_path / experiment.name, plan)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(Trainer(preset).weights_bytes())
    assert seeds_with_policies(of_chapter_4, experiment, tmp_path) == [0]
    rows = attended_rows(of_chapter_4, experiment, tmp_path, seed=0)
    assert [label for label, _ in rows] == [
        "two joints:\nPGAIL-BiD",
        "two joints:\nbehaviour cloning",
        "one joint:\nPGAIL-BiD",
        "one joint:\nbehaviour cloning",
    ]
    assert {len(steps) for _, steps in rows} == {of_chapter_4.steps}
    one = replace(of_chapter_4, panels=("one joint",))
    some = attended_rows(one, experiment, tmp_path, seed=0)
    assert [label for label, _ in some] == ["PGAIL-BiD", "behaviour cloning"]


def test_heat_on_cloth_is_told_from_heat_beside_it() -> None:
    picture = np.full((84, 84, 3), 100, np.uint8)
    picture[:21] = (200, 30, 30)  # a quarter is cloth
    heat = np.zeros((84, 84), np.float32)
    heat[11:31] = 1.0  # half on it
    step = AttendedStep(picture, 0, heat, 0.0)
    assert (step.heat_on_cloth, step.cloth_share) == (0.5, 0.25)
    blind = replace(step, heat=np.zeros_like(heat))
    assert math.isnan(blind.heat_on_cloth)
    rows = {0: [("shirt:\nBiD", [step, blind])], 1: [("shirt:\nBiD", [step])]}
    assert "| shirt: BiD | 2 | 50% | 50% to 50% | 25% | 25% to 25% |" in heat_table(rows)
