"""The tasks as gymnasium environments, registered under `clothbus/` when this is imported.

| id | task | source |
|---|---|---|
| `clothbus/Reaching-v0` | n-DOF reaching | chapters 3.2, 4.2 |
| `clothbus/HandkerchiefFlip36-v0` | handkerchief flipping, 6 pick x 6 drop points | chapter 3.3.1 |
| `clothbus/HandkerchiefFlip60-v0` | the same, 10 x 6, after 3 random actions | chapter 4.3.1 |
| `clothbus/TShirtFold-v0` | t-shirt folding, 10 pick x 20 drop points | chapter 3.3.2 |
| `clothbus/ShirtFold-v0` | shirt folding along 6 lines | chapter 4.3.2 |
| `clothbus/TrousersFold-v0` | trousers folding along 6 lines | chapter 4.3.2 |
| `clothbus/HandkerchiefFold-v0` | handkerchief folding up, right, left; 32 x 32 | appendix |

Every `info` holds `success` (bool) and `guard` (None, or why the step must not be learned from).
"""

import importlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, SupportsIndex

import gymnasium
import numpy as np
from numpy.typing import NDArray

from actors.envs.difficulties import (
    FLIPPING,
    FOLDING,
    TSHIRT,
    Difficulty,
    check_difficulty,
)

if TYPE_CHECKING:
    from actors.envs.cloth_options import ClothTaskOptions
    from actors.envs.cloth_task import ClothTaskEnv
    from actors.envs.fold_lines import FoldLinesEnv
    from actors.envs.handkerchief import HandkerchiefFlipEnv
    from actors.envs.reaching import ReachingEnv
    from actors.envs.tshirt import TshirtFoldEnv

__all__ = [
    "ENV_IDS",
    "ClothTaskEnv",
    "ClothTaskOptions",
    "ClothbusEnv",
    "FoldLinesEnv",
    "HandkerchiefFlipEnv",
    "ReachingEnv",
    "TshirtFoldEnv",
    "make_env",
]

_HOMES: Final[Mapping[str, str]] = {
    "ClothTaskEnv": "cloth_task",
    "ClothTaskOptions": "cloth_options",
    "FoldLinesEnv": "fold_lines",
    "HandkerchiefFlipEnv": "handkerchief",
    "ReachingEnv": "reaching",
    "TshirtFoldEnv": "tshirt",
}
"""In which module of this package each class is."""


def _load(name: str) -> Any:
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Imports a class when it is asked for: an arm that reaches needs no cloth engine."""
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return _load(name)


ClothbusEnv = gymnasium.Env[NDArray[np.uint8], SupportsIndex]


@dataclass(frozen=True)
class _Task:
    """An environment's class and what its id fixes; the rest are the class's defaults."""

    class_name: str
    arguments: Mapping[str, Any] = field(default_factory=dict)

    @property
    def env_class(self) -> type[ClothbusEnv]:
        """The class."""
        loaded: type[ClothbusEnv] = _load(self.class_name)
        return loaded

    @property
    def metadata(self) -> dict[str, Any]:
        """The class's: gymnasium asks whoever makes an environment for it."""
        return self.env_class.metadata

    def known(self) -> list[str]:
        """Names of all keywords that a call takes."""
        return list(inspect.signature(self.env_class).parameters)

    def __call__(self, **given: Any) -> ClothbusEnv:
        """The environment."""
        make: Callable[..., ClothbusEnv] = self.env_class
        return make(**{**self.arguments, **given})


@dataclass(frozen=True)
class _ClothTask(_Task):
    """A cloth task: keywords are its class's arguments and fields of `ClothTaskOptions`."""

    options: Mapping[str, Any] = field(default_factory=dict)
    difficulties: Mapping[Difficulty, Mapping[str, Any]] = field(default_factory=dict)
    """Further options, where the task has difficulties."""

    @property
    def _options_class(self) -> "type[ClothTaskOptions]":
        loaded: type[ClothTaskOptions] = _load("ClothTaskOptions")
        return loaded

    def known(self) -> list[str]:
        """Names of all keywords that a call takes."""
        own = [name for name in super().known() if name != "options"]
        own += ["difficulty"] if self.difficulties else []
        return own + list(self._options_class.__dataclass_fields__)

    def __call__(self, **given: Any) -> ClothbusEnv:
        """The environment."""
        further: Mapping[str, Any] = {}
        if self.difficulties:
            difficulty = given.pop("difficulty", "medium")
            check_difficulty(difficulty)
            further = self.difficulties[difficulty]
        is_option = self._options_class.__dataclass_fields__.__contains__
        own = {name: given.pop(name) for name in list(given) if not is_option(name)}
        options = self._options_class(**{**self.options, **further, **given})
        return super().__call__(**own, options=options)


_TASKS: Final[Mapping[str, _Task]] = {
    "clothbus/Reaching-v0": _Task("ReachingEnv"),
    "clothbus/HandkerchiefFlip36-v0": _ClothTask(
        "HandkerchiefFlipEnv", {"pick_rule": "grid"}, {}, FLIPPING
    ),
    "clothbus/HandkerchiefFlip60-v0": _ClothTask(
        "HandkerchiefFlipEnv", {"pick_rule": "contour"}, {"initial_state": "random"}, FLIPPING
    ),
    "clothbus/TShirtFold-v0": _ClothTask(
        "TshirtFoldEnv", {}, {"horizon": 8, "view_half_width_m": 0.32}, TSHIRT
    ),
    "clothbus/ShirtFold-v0": _ClothTask(
        "FoldLinesEnv", {"garment": "shirt"}, {"horizon": 3, "view_half_width_m": 0.32}, FOLDING
    ),
    "clothbus/TrousersFold-v0": _ClothTask(
        "FoldLinesEnv", {"garment": "trousers"}, {"horizon": 2, "view_half_width_m": 0.32}, FOLDING
    ),
    "clothbus/HandkerchiefFold-v0": _ClothTask(
        "FoldLinesEnv",
        {"garment": "handkerchief"},
        {"horizon": 2, "observation_px": 32, "robot_stance": "left"},
        FOLDING,
    ),
}

ENV_IDS: Final = tuple(_TASKS)
"""The ids that `make_env` knows."""


def make_env(env_id: str, **given: Any) -> ClothbusEnv:
    """A task, without gymnasium's wrappers: the tasks themselves refuse what is out of the rule.

    Args:
        env_id: one of `ENV_IDS`.
        **given: arguments of the task's class and, for cloth, a `difficulty` and fields of
            `ClothTaskOptions`, where they differ from the task's defaults.

    Raises:
        ValueError: there is no such task, or it has no such argument, or an argument is out of
            its rule.
    """
    if env_id not in _TASKS:
        raise ValueError(
            f"environment id: expected one of {', '.join(ENV_IDS)}; got {env_id!r}; "
            "name one of them"
        )
    known = _TASKS[env_id].known()
    if unknown := sorted(set(given) - set(known)):
        raise ValueError(
            f"{env_id}: expected some of the arguments {', '.join(known)}; got "
            f"{', '.join(unknown)}; leave out what this task lacks"
        )
    env: ClothbusEnv = gymnasium.make(env_id, disable_env_checker=True, **given)
    return env


def _register() -> None:
    for env_id, task in _TASKS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, entry_point=task, order_enforce=False)


_register()
