"""Episodes of a task alone, without a bus or a learner, in several processes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from actors.envs import ClothbusEnv
from actors.rollout import ActingPolicy
from broker_config.errors import StorageError
from broker_config.messages import Trajectory
from deploy.process import end_with_parent

T = TypeVar("T")
R = TypeVar("R")

GUARDED_ATTEMPTS = 20
"""Seeds after which an episode that the guard ends each time is given up."""


@dataclass(frozen=True)
class PlayedEpisode:
    """How an episode went."""

    success_at_end: bool
    success_at_best: bool
    guard: str | None
    steps: int
    steps_to_success: int | None
    return_: float
    measures: Mapping[str, float]
    """The task's own, at the end."""


def play_episode(env: ClothbusEnv, policy: ActingPolicy, number: int) -> PlayedEpisode:
    """Plays the episode of a number, which seeds task and player alike."""
    random = np.random.default_rng([number, 1])
    picture, info = env.reset(seed=number)
    successes, rewards, is_over = [], [], False
    while not is_over:
        picture, reward, terminated, truncated, info = env.step(policy.act(picture, random, 0.0))
        successes.append(bool(info["success"]))
        rewards.append(float(reward))
        is_over = terminated or truncated
    numbers = {
        name: float(value)
        for name, value in info.items()
        if isinstance(value, float | np.floating) and not isinstance(value, bool)
    }
    return PlayedEpisode(
        successes[-1],
        any(successes),
        info["guard"],
        len(successes),
        successes.index(True) + 1 if any(successes) else None,
        sum(rewards),
        numbers,
    )


def sound_episode(index: int, play: Callable[[int], Trajectory]) -> Trajectory:
    """Plays an episode; one that the guard ends is played again on the next seed.

    Args:
        index: Of the episode, for the error.
        play: Plays it with the seed of a generation, counted from 0.

    Raises:
        StorageError: No seed gives a sound episode.
    """
    for generation in range(GUARDED_ATTEMPTS):
        played = play(generation)
        if played.guard is None:
            return played
    raise StorageError(
        f"episode {index}: expected a sound attempt with one of {GUARDED_ATTEMPTS} seeds; got "
        f"{played.guard}; mend the task or the simulator"
    )


def mapped(play: Callable[[T], R], chunks: list[T], jobs: int) -> Iterator[R]:
    """What `play` makes of each chunk, in order, with so many processes.

    Raises:
        StorageError: A process was killed.
    """
    if jobs == 1:
        yield from map(play, chunks)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, end_with_parent, (os.getpid(),)) as pool:
        try:
            yield from pool.map(play, chunks)
        except BrokenProcessPool as error:
            raise StorageError(
                "episodes: expected processes that live; got one that was killed, perhaps for want "
                "of memory; run the command again, with fewer of them"
            ) from error
