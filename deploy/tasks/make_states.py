"""`clothbus states`: makes initial states of a task, to be stored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import Any, Final

import numpy as np

from actors.cloth.engine import ClothEngineError
from actors.envs import ClothTaskEnv, make_env
from actors.envs.randomisation import make_randomisation
from actors.envs.stored_states import StoredStates, mesh_digest, on_grid
from broker_config.errors import PresetError, StorageError

MOST_SEEDS: Final = 10
"""So many times as many seeds as are wanted are tried at most."""


def make_states(
    env_id: str, options: Mapping[str, Any], names: Sequence[str], seeds: int
) -> StoredStates:
    """Lays a task's garment in initial states.

    Seeds count from 0 for each name. One at which the task is solved before the first action is
    left out.

    Args:
        env_id: of a cloth task.
        options: keywords of the environment.
        names: of the states.
        seeds: how many states of each name there shall be.

    Raises:
        ValueError: the task, an option or a name does not exist.
        PresetError: it is no cloth task, or its garment's size is drawn by chance.
        StorageError: the simulator does not make sound states, or none that are unsolved.
    """
    env = make_env(env_id, **options).unwrapped
    with closing(env):
        if not isinstance(env, ClothTaskEnv):
            raise PresetError(
                f"{env_id}: expected a task with cloth; got one without; name another"
            )
        if make_randomisation(env.options.randomisation).size > 0.0:
            raise PresetError(
                f"randomisation: expected one that leaves the garment's size alone; got "
                f"{env.options.randomisation!r}; stored cloth has one size, choose another"
            )
        made = [(name, *made) for name in dict.fromkeys(names) for made in _made(env, name, seeds)]
        states = StoredStates(
            env_id,
            env.garment.name,
            mesh_digest(env.garment.mesh),
            tuple(name for name, _, _ in made),
            np.array([seed for _, seed, _ in made], np.int64),
            on_grid(np.stack([vertices for _, _, vertices in made])),
        )
        states.check_garment(env.garment)
    return states


def _made(
    env: ClothTaskEnv, name: str, seeds: int
) -> list[tuple[int, np.ndarray[Any, np.dtype[np.float64]]]]:
    """Seeds, and where the vertices then are."""
    found = []
    for seed in range(MOST_SEEDS * seeds):
        try:
            _, info = env.reset(seed=seed, options={"initial_state": name})
        except ClothEngineError as error:
            raise StorageError(f"state {name} of seed {seed}: {error}") from error
        if not info["success"]:
            found.append((seed, env.vertices_in_world()))
        if len(found) == seeds:
            return found
    raise StorageError(
        f"state {name}: expected {seeds} at which the task is unsolved; got {len(found)} of "
        f"{MOST_SEEDS * seeds} seeds; make another state, or a harder task"
    )
