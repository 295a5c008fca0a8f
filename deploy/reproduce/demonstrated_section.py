"""What was demonstrated to the runs of an experiment, for its page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from actors.demonstrate.reaching_range import best_reaching_return, chance_reaching_return
from actors.envs.planar_arm import INCREMENTS_RAD
from broker_config.preset import TaskPreset
from deploy.reproduce.experiment import Panel
from deploy.reproduce.panel_runs import PanelRuns

_REACHING = "clothbus/Reaching-v0"


def demonstrated_returns(panel_runs: PanelRuns, task: TaskPreset) -> str:
    """How good a panel's demonstrations are, in a sentence; nothing where there are none.

    Args:
        panel_runs: The panel's finished runs.
        task: Which was demonstrated.
    """
    returns = panel_runs.demonstrated_returns()
    if not returns:
        return ""
    mean = float(np.mean(list(returns.values())))
    by_seed = ", ".join(f"{value:.1f}" for value in returns.values())
    said = f"Demonstrations: mean return {mean:.2f} (seed by seed {by_seed})"
    if task.environment != _REACHING:
        return f"{said}."
    n_joints = task.n_actions // len(INCREMENTS_RAD)
    chance = chance_reaching_return(n_joints, task.horizon)
    best = best_reaching_return(n_joints, task.horizon)
    quality = (mean - chance) / (best - chance)
    return (
        f"{said}: quality {quality:.2f}, where 0 is chance ({chance:.1f}) and 1 the best that beam "
        f"search finds ({best:.1f})."
    )


def who_demonstrated(panels: Sequence[PanelRuns]) -> list[str]:
    """Who demonstrated to an experiment's runs, as lines of a list."""
    runs = [run for each in panels for its in each.runs.values() for run in its]
    rates = sorted({run.key.mistake_rate for run in runs if run.key.mistake_rate is not None})
    lines = []
    if rates:
        lines.append(
            f"* Demonstrations: the task's script, {' or '.join(f'{rate:.0%}' for rate in rates)} "
            "of its actions random, drawn anew for each seed and the same for all conditions of "
            "it; they begin where a run's first episodes do."
        )
    lines += _policies_under_training(it.panel for it in panels if any(it.runs.values()))
    return lines


def _policies_under_training(panels: Iterable[Panel]) -> list[str]:
    updates: dict[tuple[str, ...], list[int]] = {}
    for panel in panels:
        if panel.demonstrator is not None:
            updates.setdefault(panel.demonstrator.overrides, []).append(panel.demonstrator.updates)
    return [
        "* Demonstrations by a policy under training: a learner that sees the task's own rewards, "
        f"with {', '.join(f'`{it}`' for it in overrides)}, demonstrates after "
        f"{' or '.join(map(str, sorted(set(its))))} updates; another for each seed, the same for "
        "all conditions of it, drawn anew only where targets are too few."
        for overrides, its in updates.items()
    ]
