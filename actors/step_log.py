"""A log on the environment's side: what was really done, against which a journal can be checked."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any, SupportsIndex

import gymnasium
import numpy as np
from numpy.typing import NDArray

from actors.envs import ClothbusEnv


def observation_digest(observation: NDArray[np.uint8]) -> str:
    """A short digest of a picture, as the log holds it."""
    return hashlib.sha256(np.ascontiguousarray(observation).tobytes()).hexdigest()[:16]


class StepLog(
    gymnasium.Wrapper[NDArray[np.uint8], SupportsIndex, NDArray[np.uint8], SupportsIndex]
):
    """Appends one JSON line for each step to a file, before the actor learns of the step.

    Each line is one `write` to a file opened for appending, so that a killed process leaves whole
    lines and several processes may share the file.
    """

    def __init__(self, env: ClothbusEnv, path: Path, incarnation: str) -> None:
        super().__init__(env)
        self._incarnation = incarnation
        self._episode = -1
        self._step = 0
        self._seed: int | None = None
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def reset(self, **options: Any) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Begins an episode; the log tells episodes apart by a count and their seed."""
        self._episode += 1
        self._step = 0
        self._seed = options.get("seed")
        return super().reset(**options)

    def step(
        self, action: SupportsIndex
    ) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Takes a step and logs it."""
        observation, reward, terminated, truncated, info = super().step(action)
        line = {
            "incarnation": self._incarnation,
            "episode": self._episode,
            "seed": self._seed,
            "step": self._step,
            "action": int(action),
            "reward": float(reward),
            "observation": observation_digest(observation),
        }
        self._step += 1
        os.write(self._file, (json.dumps(line) + "\n").encode())
        return observation, float(reward), terminated, truncated, info

    def close(self) -> None:
        """Closes the log with the environment."""
        os.close(self._file)
        super().close()
