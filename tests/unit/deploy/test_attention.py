"""Pictures of what policies look at."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from actors.policy import Policy
from broker_config.errors import StorageError
from deploy.attention import attend, draw_attention
from deploy.presets import load_preset
from deploy.reproduce.attention_figure import attended_rows
from deploy.reproduce.catalogue import ATTENTION_FIGURES, EXPERIMENTS
from learner.trainer import Trainer

torch.set_num_threads(1)
PRESET = load_preset("reaching-smoke")


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
        panels = EXPERIMENTS[figure.experiment].panels
        known = {condition.name for panel in panels for condition in panel.conditions}
        assert set(figure.conditions) <= known
        with pytest.raises(StorageError, match="run its experiment first"):
            attended_rows(replace(figure, seed=1), tmp_path)
