"""Demonstrators as acting policies: the task's script, with mistakes at a chosen rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from actors.demonstrate.scripted import (
    imperfect_action,
    scripted_flip_action,
    scripted_reach_action,
)
from actors.envs import ClothbusEnv, HandkerchiefFlipEnv, ReachingEnv
from actors.rollout import Observation


@dataclass(frozen=True)
class ScriptedDemonstrator:
    """Follows a script, except for a share of random actions."""

    script: Callable[[Observation], int]
    n_actions: int
    mistake_rate: float

    def act(self, observation: Observation, generator: np.random.Generator, epsilon: float) -> int:
        """The script's action, or by mistake any."""
        del epsilon
        action = self.script(observation)
        return imperfect_action(action, self.n_actions, self.mistake_rate, generator)


def scripted_demonstrator(
    env: ClothbusEnv, n_actions: int, mistake_rate: float
) -> ScriptedDemonstrator:
    """The demonstrator of a task.

    Args:
        env: The one that it will act in: a script of reaching reads the arm's angles from it.
        n_actions: Of the task.
        mistake_rate: Share of its actions that are random, 0 to 1.

    Raises:
        ValueError: The task has no script.
    """
    task = env.unwrapped
    if isinstance(task, ReachingEnv):
        return ScriptedDemonstrator(
            lambda _: scripted_reach_action(task.joint_angles_rad),
            n_actions,
            mistake_rate,
        )
    if isinstance(task, HandkerchiefFlipEnv):
        return ScriptedDemonstrator(
            lambda picture: scripted_flip_action(
                picture,
                task.pick_rule,
                cloth_size_m=task.cloth_size_m,
                view_half_width_m=task.view_half_width_m,
            ),
            n_actions,
            mistake_rate,
        )
    raise ValueError(f"demonstrator: expected a task with a script; got {type(task).__name__}")
