"""A task's self-test: its scripted expert must succeed, and chance must not flip a cloth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from rich.table import Table

from actors.acting import UniformlyRandom
from actors.demonstrate.acting import scripted_demonstrator
from actors.envs import ClothbusEnv, make_env
from actors.rollout import ActingPolicy
from deploy.evaluation.played_episodes import PlayedEpisode, mapped, play_episode

LEAST_EXPERT: Final = 0.95
"""Portion of the expert's episodes that must end in success."""

MOST_CHANCE: Final = 0.10
"""Portion of random play's episodes that may end in success where it has thirty tries: flipping.

Among two or three actions of a few, chance may well name the right ones.
"""

Player = Literal["expert", "chance"]
PLAYERS: Final[tuple[Player, ...]] = ("expert", "chance")
QUANTILES: Final = (0.02, 0.5, 0.98)


@dataclass(frozen=True)
class TaskCheck:
    """What expert and chance achieve at a task."""

    env_id: str
    options: Mapping[str, Any]
    episodes: Mapping[Player, Sequence[PlayedEpisode]]

    @property
    def holds(self) -> bool:
        """Whether the expert succeeds often enough, and chance flips seldom enough."""
        by_chance = self.rate("chance") if "Flip" in self.env_id else 0.0
        return self.rate("expert") >= LEAST_EXPERT and by_chance <= MOST_CHANCE

    def rate(self, player: Player) -> float:
        """The portion of episodes that ended in success."""
        return float(np.mean([it.success_at_end for it in self.episodes[player]]))

    def table(self) -> Table:
        """For the console."""
        table = Table("", *PLAYERS, title=f"{self.env_id}: {self._described()}")
        rows: list[tuple[str, Callable[[Sequence[PlayedEpisode]], str]]] = [
            ("episodes", lambda them: str(len(them))),
            ("success at the end", lambda them: _portion(it.success_at_end for it in them)),
            ("success at some step", lambda them: _portion(it.success_at_best for it in them)),
            ("actions to success, median", _median_actions),
            ("stopped by the guard", lambda them: _portion(it.guard is not None for it in them)),
            ("return, mean", lambda them: f"{np.mean([it.return_ for it in them]):.2f}"),
        ]
        for name, cell in rows:
            table.add_row(name, *(cell(self.episodes[player]) for player in PLAYERS))
        for measure in self.episodes["expert"][0].measures:
            cells = [_quantiles(self.episodes[player], measure) for player in PLAYERS]
            table.add_row(f"{measure} at the end: 2 %, median, 98 %", *cells)
        return table

    def _described(self) -> str:
        return ", ".join(f"{name}={value}" for name, value in self.options.items()) or "as it is"


def check_task(env_id: str, options: Mapping[str, Any], episodes: int, jobs: int) -> TaskCheck:
    """Plays a task's script and random actions on the same seeds.

    Args:
        env_id: of `actors.envs.ENV_IDS`.
        options: keywords of the environment.
        episodes: for either player.
        jobs: processes.

    Raises:
        ValueError: the task or an option does not exist, or the task has no script.
    """
    make_env(env_id, **options).close()  # a wrong option is told here, not in a worker
    chunks = [
        (player, list(range(first, episodes, jobs))) for player in PLAYERS for first in range(jobs)
    ]
    by_player: dict[Player, list[PlayedEpisode]] = {player: [] for player in PLAYERS}
    play = partial(_play, env_id, dict(options))
    for (player, _), played in zip(chunks, mapped(play, chunks, jobs), strict=True):
        by_player[player] += played
    return TaskCheck(env_id, dict(options), by_player)


Chunk = tuple[Player, list[int]]
"""Who plays episodes of which numbers, in one environment."""


def _play(env_id: str, options: dict[str, Any], chunk: Chunk) -> list[PlayedEpisode]:
    player, numbers = chunk
    env = make_env(env_id, **options)
    try:
        policy = _policy(player, env)
        return [play_episode(env, policy, number) for number in numbers]
    finally:
        env.close()


def _policy(player: Player, env: ClothbusEnv) -> ActingPolicy:
    n_actions = int(env.action_space.n)  # type: ignore[attr-defined]  # all tasks are discrete
    if player == "chance":
        return UniformlyRandom(n_actions)
    return scripted_demonstrator(env, n_actions, mistake_rate=0.0)


def _portion(them: Iterator[bool]) -> str:
    return f"{np.mean(list(them)):.0%}"


def _median_actions(them: Sequence[PlayedEpisode]) -> str:
    steps = [it.steps_to_success for it in them if it.steps_to_success is not None]
    return f"{np.median(steps):g}" if steps else "none"


def _quantiles(them: Sequence[PlayedEpisode], measure: str) -> str:
    values = [it.measures[measure] for it in them if measure in it.measures]
    return ", ".join(f"{value:.3f}" for value in np.quantile(values, QUANTILES)) if values else ""
