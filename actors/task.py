"""A preset's task: its environment, checked against what the preset promises."""

from __future__ import annotations

from actors.envs import ClothbusEnv, make_env
from broker_config.errors import PresetError
from broker_config.preset import TaskPreset


def make_task_env(task: TaskPreset) -> ClothbusEnv:
    """The preset's environment, checked against the shapes that the preset promises.

    Raises:
        PresetError: Environment and preset disagree.
    """
    try:
        env = make_env(task.environment, horizon=task.horizon, **task.options)
    except ValueError as error:
        raise PresetError(f"task: {error}") from error
    space, actions = env.observation_space, env.action_space
    got = (tuple(space.shape or ()), int(getattr(actions, "n", 0)))
    if got != (tuple(task.observation_shape), task.n_actions):
        env.close()
        raise PresetError(
            f"{task.environment}: expected observations {list(task.observation_shape)} and "
            f"{task.n_actions} actions (preset); got {list(got[0])} and {got[1]}; correct it"
        )
    return env
