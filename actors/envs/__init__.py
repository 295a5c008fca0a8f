"""The tasks as gymnasium environments, registered under `clothbus/` when this is imported.

| id | task | source |
|---|---|---|
| `clothbus/Reaching-v0` | n-DOF reaching | chapters 3.2, 4.2 |
| `clothbus/HandkerchiefFlip36-v0` | handkerchief flipping, 6 pick x 6 drop points | chapter 3.3.1 |
| `clothbus/HandkerchiefFlip60-v0` | the same, 10 x 6, after 3 random actions | chapter 4.3.1 |

Every `info` holds `success` (bool) and `guard` (None, or why the step must not be learned from).
"""

import inspect
from typing import Any, SupportsIndex

import gymnasium
import numpy as np
from numpy.typing import NDArray

from actors.envs.handkerchief import HandkerchiefFlipEnv
from actors.envs.reaching import ReachingEnv

__all__ = ["ENV_IDS", "ClothbusEnv", "HandkerchiefFlipEnv", "ReachingEnv", "make_env"]

ClothbusEnv = gymnasium.Env[NDArray[np.uint8], SupportsIndex]

_TASKS: dict[str, tuple[type[ClothbusEnv], dict[str, Any]]] = {
    "clothbus/Reaching-v0": (ReachingEnv, {}),
    "clothbus/HandkerchiefFlip36-v0": (HandkerchiefFlipEnv, {"pick_rule": "grid"}),
    "clothbus/HandkerchiefFlip60-v0": (
        HandkerchiefFlipEnv,
        {"pick_rule": "contour", "random_actions_at_start": 3},
    ),
}

ENV_IDS = tuple(_TASKS)
"""The ids that `make_env` knows."""


def make_env(env_id: str, **kwargs: Any) -> ClothbusEnv:
    """A task, without gymnasium's wrappers: the tasks themselves refuse what is out of the rule.

    Args:
        env_id: one of `ENV_IDS`.
        **kwargs: arguments of the task's class, where they differ from its defaults.

    Raises:
        ValueError: there is no such task, or it has no such argument, or an argument is out of
            its rule.
    """
    if env_id not in _TASKS:
        raise ValueError(
            f"environment id: expected one of {', '.join(ENV_IDS)}; got {env_id!r}; "
            "name one of them"
        )
    task, _ = _TASKS[env_id]
    known = list(inspect.signature(task).parameters)
    unknown = sorted(set(kwargs) - set(known))
    if unknown:
        raise ValueError(
            f"{env_id}: expected some of the arguments {', '.join(known)}; got "
            f"{', '.join(unknown)}; leave out what this task lacks"
        )
    env: ClothbusEnv = gymnasium.make(env_id, disable_env_checker=True, **kwargs)
    return env


def _register() -> None:
    for env_id, (task, defaults) in _TASKS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point=f"{task.__module__}:{task.__name__}",
                order_enforce=False,
                kwargs=dict(defaults),
            )


_register()
