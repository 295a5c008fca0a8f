"""How many mistakes make a demonstrator as good as is wanted, found by bisection.

Quality is the mean score, 0 for chance and 1 for the script. A score is an episode's return; of
folding along lines it is the success at the end, since returns there hardly tell: half-folded
garments cover as much of the target as unfolded ones. A demonstrator makes the script's
actions and, at some rate, random ones instead; all rates are tried on the same seeds, where a
higher rate only adds mistakes to those of a lower one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Final

from actors.demonstrate.acting import scripted_demonstrator
from actors.envs import FoldLinesEnv
from actors.task import make_task_env
from broker_config.errors import PresetError
from broker_config.messages import Demonstrator, FoundQuality
from broker_config.preset import TaskPreset
from deploy.evaluation.played_episodes import mapped, play_episode

TOLERANCE: Final = 0.02
MOST_HALVINGS: Final = 7
FIRST_SEED: Final = 500_000
"""Of the episodes by which quality is measured: no run and no test of a task plays them."""


def find_quality(
    task: TaskPreset,
    wanted: float,
    episodes: int,
    jobs: int = 1,
    on_measured: Callable[[float, float], None] | None = None,
) -> Demonstrator:
    """The script with the rate of mistakes that gives a quality.

    Args:
        task: Which the demonstrator plays.
        wanted: The quality, from 0 to 1.
        episodes: For each rate that is tried.
        jobs: Processes.
        on_measured: Told each rate and its quality.

    Raises:
        PresetError: The quality is not from 0 to 1, or the task has no script, or one that is no
            better than chance.
    """
    if not 0.0 <= wanted <= 1.0:
        raise PresetError(f"quality: expected 0 (chance) to 1 (the script); got {wanted:g}")
    for name, value in (("quality_episodes", episodes), ("jobs", jobs)):
        if value < 1:
            raise PresetError(f"{name}: expected at least 1; got {value}")
    mean_score = partial(_mean_score, task, episodes, jobs)
    script, chance = mean_score(0.0), mean_score(1.0)
    if script <= chance:
        raise PresetError(
            f"{task.environment}: expected a script that is better than chance; got mean scores "
            f"{script:.2f} and {chance:.2f}; demonstrations of a set quality have no meaning here"
        )
    found: dict[float, float] = {0.0: 1.0, 1.0: 0.0}
    low, high = 0.0, 1.0
    for _ in range(MOST_HALVINGS):
        best = min(found, key=lambda rate: abs(found[rate] - wanted))
        if abs(found[best] - wanted) <= TOLERANCE:
            break
        rate = (low + high) / 2
        found[rate] = (mean_score(rate) - chance) / (script - chance)
        if on_measured is not None:
            on_measured(rate, found[rate])
        low, high = (rate, high) if found[rate] > wanted else (low, rate)
    best = min(found, key=lambda rate: abs(found[rate] - wanted))
    return Demonstrator(
        "scripted", best, FoundQuality(wanted, found[best], chance, script, episodes)
    )


def _mean_score(task: TaskPreset, episodes: int, jobs: int, mistake_rate: float) -> float:
    numbers = range(FIRST_SEED, FIRST_SEED + episodes)
    chunks = [list(numbers[first::jobs]) for first in range(min(jobs, episodes))]
    play = partial(_scores, task, mistake_rate)
    # Exactly rounded, so that the number of processes does not matter.
    return math.fsum(value for chunk in mapped(play, chunks, jobs) for value in chunk) / episodes


def _scores(task: TaskPreset, mistake_rate: float, numbers: list[int]) -> list[float]:
    with closing(make_task_env(task)) as env:
        try:
            policy = scripted_demonstrator(env, task.n_actions, mistake_rate)
        except ValueError as error:
            raise PresetError(f"{task.environment}: {error}") from error
        played = [play_episode(env, policy, number) for number in numbers]
        if isinstance(env.unwrapped, FoldLinesEnv):
            return [float(it.success_at_end) for it in played]
        return [it.return_ for it in played]
