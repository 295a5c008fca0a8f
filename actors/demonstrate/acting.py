"""Demonstrators as acting policies: the task's script, with mistakes at a chosen rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from actors.demonstrate.folding import scripted_tshirt_action
from actors.demonstrate.looking_ahead import FlipExpert
from actors.demonstrate.scripted import imperfect_action, scripted_reach_action
from actors.envs import (
    ClothbusEnv,
    FoldLinesEnv,
    HandkerchiefFlipEnv,
    ReachingEnv,
    TshirtFoldEnv,
)
from actors.rollout import Observation

Script = Callable[[Observation], int]


@dataclass(frozen=True)
class ScriptedDemonstrator:
    """Follows a script, except for a share of random actions."""

    script: Script
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
        env: The one that it will act in. Scripts see its pictures; that of reaching also the arm's
            angles, those of folding along lines which step it is, that of flipping the cloth.
        n_actions: Of the task.
        mistake_rate: Share of its actions that are random, 0 to 1.

    Raises:
        ValueError: The task has no script.
    """
    return ScriptedDemonstrator(_script(env), n_actions, mistake_rate)


def _script(env: ClothbusEnv) -> Script:
    task = env.unwrapped
    if isinstance(task, ReachingEnv):
        return lambda _: scripted_reach_action(task.joint_angles_rad)
    if isinstance(task, HandkerchiefFlipEnv):
        expert = FlipExpert(task)
        return lambda _: expert.action()
    if isinstance(task, TshirtFoldEnv):
        return lambda picture: scripted_tshirt_action(picture, task.camera)
    if isinstance(task, FoldLinesEnv):
        return lambda _: task.task.script[min(task.steps_done, len(task.task.script) - 1)]
    raise ValueError(f"demonstrator: expected a task with a script; got {type(task).__name__}")
