"""What portion of a task's actions the robot can make, and what is in the way of the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rich.table import Table

from actors.demonstrate.acting import scripted_demonstrator
from actors.envs import ClothTaskEnv, make_env
from actors.robot.planning import Obstacle

Obstacles = Counter[Obstacle | None]
"""How often an action met which; None where it met none."""


@dataclass(frozen=True)
class ReachCheck:
    """What the robot met in episodes of a task's script."""

    env_id: str
    options: Mapping[str, Any]
    all_actions: Obstacles = field(default_factory=Counter)
    """Of every action in every state."""

    scripted: Obstacles = field(default_factory=Counter)
    """Of the script's actions."""

    def table(self) -> Table:
        """For the console."""
        options = ", ".join(f"{name}={value}" for name, value in self.options.items())
        table = Table("", "all", "scripted", title=f"{self.env_id}: {options or 'as it is'}")
        columns = (self.all_actions, self.scripted)
        table.add_row("actions", *(str(column.total()) for column in columns))
        for obstacle in (None, *Obstacle):
            if any(column[obstacle] for column in columns):
                name = "reachable" if obstacle is None else obstacle.value
                table.add_row(name, *(f"{portion(column, obstacle):.1%}" for column in columns))
        return table


def portion(met: Obstacles, obstacle: Obstacle | None) -> float:
    """Of actions that met an obstacle, or None: that met none."""
    return met[obstacle] / met.total()


def check_reach(env_id: str, options: Mapping[str, Any], episodes: int) -> ReachCheck:
    """Plays a task's script with the robot; an action that it cannot make leaves the cloth.

    Args:
        env_id: of `actors.envs.ENV_IDS`, a cloth task.
        options: keywords of the environment.
        episodes: how many, with seeds from 0 on.

    Raises:
        ValueError: the task or an option does not exist, or the task has no cloth.
    """
    env = make_env(env_id, **{**options, **_with_robot(env_id)})
    task = env.unwrapped
    assert isinstance(task, ClothTaskEnv)
    assert task.arms is not None
    check = ReachCheck(env_id, dict(options))
    expert = scripted_demonstrator(task, task.n_actions, mistake_rate=0.0)
    try:
        for seed in range(episodes):
            random = np.random.default_rng([seed, 1])
            picture, _ = task.reset(seed=seed)
            is_over = False
            while not is_over:
                action = expert.act(picture, random, 0.0)
                check.all_actions.update(task.arms.obstacles)
                check.scripted[task.arms.obstacles[action]] += 1
                picture, _, _, is_over, _ = task.step(action)
    finally:
        env.close()
    return check


def _with_robot(env_id: str) -> dict[str, Any]:
    if "Reaching" in env_id:
        raise ValueError(
            f"{env_id}: expected a task with cloth for the robot; got one without; name another"
        )
    return {"robot": True}
