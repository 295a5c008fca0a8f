"""Evaluation: how episodes of a policy version are played, kept and turned into a score."""

from __future__ import annotations

import errno
import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from actors.acting import Greedy, Sampled
from actors.cloth.guard import GuardReason
from actors.envs.stored_states import read_stored_states
from actors.policy import Policy
from actors.rollout import collect
from actors.task import make_task_env
from broker_config.closing import Closing
from broker_config.errors import StorageError
from broker_config.messages import Ticket, Trajectory, TrajectoryId
from broker_config.ownership import FileLock
from broker_config.preset import AlgorithmPreset, Preset
from broker_config.structure import from_plain, to_plain
from learner.tickets import derive_seed

Mode = Literal["sampled", "greedy"]

EVALUATION_STREAM = 2**31
"""Keeps the seeds of evaluation apart from those of every ticket of the run."""

BOOTSTRAP_SAMPLES = 10_000
GUARDED_ATTEMPTS = 20

LOST_SIMULATORS = 10
"""A simulator that dies is not the seed's fault, but one seed must not kill simulators for ever."""

EpisodeKey = tuple[int, Mode, int]
"""Policy version, mode, number."""


@dataclass(frozen=True)
class Episode:
    """The result of one evaluation episode."""

    version: int
    mode: Mode
    number: int
    """Names the episode's seed, and the stored state where it begins with one."""
    return_: float
    success: bool

    @property
    def key(self) -> EpisodeKey:
        """What there is at most one episode of."""
        return self.version, self.mode, self.number


@dataclass(frozen=True)
class Score:
    """What a policy version achieved."""

    version: int
    mode: Mode
    episodes: int
    mean_return: float
    return_interval: tuple[float, float]
    """Bootstrap, 95 %."""
    success_rate: float
    success_interval: tuple[float, float]
    returns: tuple[float, ...]

    @property
    def numbers(self) -> Mapping[str, float]:
        """The score as metrics: `sampled/return_low` and the like."""
        named = {
            "return": self.mean_return,
            "return_low": self.return_interval[0],
            "return_high": self.return_interval[1],
            "success": self.success_rate,
            "success_low": self.success_interval[0],
            "success_high": self.success_interval[1],
            "episodes": float(self.episodes),
        }
        return {f"{self.mode}/{name}": number for name, number in named.items()}


def modes_of(algorithm: AlgorithmPreset) -> tuple[Mode, ...]:
    """The ways in which a method's policy can act; Q has no softmax policy."""
    return ("greedy",) if algorithm.method == "dqn" else ("sampled", "greedy")


# Playing --------------------------------------------------------------------------------------


class Player:
    """Plays evaluation episodes of a preset's task in an environment of its own.

    All versions and modes play the same seeds. An episode that the guard ends is played again on
    another seed; one whose simulator is lost, on the same. Among stored states there is no other to
    take: there an episode that the guard ends has failed.
    """

    def __init__(self, preset: Preset, stored_states: str | None = None) -> None:
        """Makes the environment.

        Args:
            preset: Whose task is played.
            stored_states: Where given, episode n begins with state n of this file or name.

        Raises:
            PresetError: Task and preset disagree, or the states are not of the task's garment.
        """
        self._preset = preset
        task = preset.task
        if stored_states is not None:
            task = replace(task, options={**task.options, "stored_states": stored_states})
        self._env = make_task_env(task)
        self._starts = [] if stored_states is None else read_stored_states(stored_states).starts()

    def close(self) -> None:
        """Ends the environment."""
        self._env.close()

    def play(
        self,
        policy: Policy,
        version: int,
        mode: Mode,
        number: int,
        on_step: Callable[[], None] = lambda: None,
    ) -> Episode:
        """Plays an episode; whatever `on_step` raises after a step ends it.

        Raises:
            StorageError: No seed gives a sound attempt.
        """
        for attempt in range(GUARDED_ATTEMPTS):
            trajectory = self._attempt(policy, version, mode, (number, attempt), on_step)
            is_over = self._starts and trajectory.guard != GuardReason.ENGINE_LOST
            if trajectory.guard is None or is_over:
                return Episode(version, mode, number, trajectory.return_, trajectory.success)
        raise StorageError(
            f"evaluation episode {number}: expected a sound attempt with one of "
            f"{GUARDED_ATTEMPTS} seeds; got {trajectory.guard}; mend the task or the simulator"
        )

    def _attempt(
        self,
        policy: Policy,
        version: int,
        mode: Mode,
        number_and_attempt: tuple[int, int],
        on_step: Callable[[], None],
    ) -> Trajectory:
        number, attempt = number_and_attempt
        seed = derive_seed(self._preset.seed, EVALUATION_STREAM + number, attempt, 0)
        ticket = Ticket(number, attempt, 0, seed, version, self._preset.task.horizon, 0.0)
        acting = Greedy(policy) if mode == "greedy" else Sampled(policy)
        id_ = TrajectoryId("evaluation", "evaluation", number)
        start = self._starts[number].reset_options if self._starts else None
        for _ in range(LOST_SIMULATORS):
            trajectory = collect(self._env, acting, ticket, id_, on_step, start)
            if trajectory.guard != GuardReason.ENGINE_LOST:
                break
        return trajectory


# Keeping --------------------------------------------------------------------------------------


class Results(Closing):
    """The file of evaluation episodes, one JSON line each; one process at a time may add to it.

    Attributes:
        episodes: What the file holds.
    """

    def __init__(self, path: Path) -> None:
        """Takes the file; a last line that is torn, since its process died, is cut off.

        Raises:
            AlreadyOwned: Another process evaluates into the file.
            StorageError: It cannot be used, or holds something else.
        """
        self._path = path
        self._lock = FileLock(path.with_suffix(".lock"), f"evaluation {path}")
        try:
            found, self._size_bytes = _read(path)
            self.episodes: dict[EpisodeKey, Episode] = {it.key: it for it in found}
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
            os.ftruncate(self._file, self._size_bytes)
        except OSError as error:
            self._lock.close()
            raise self._unwritable(error) from error
        except StorageError:
            self._lock.close()
            raise

    def add(self, episode: Episode) -> None:
        """Adds an episode, whole or not at all. It is not synced: a lost one is played again.

        Raises:
            StorageError: The disk refuses; the file is as it was.
        """
        line = (json.dumps(to_plain(episode)) + "\n").encode()
        try:
            if os.pwrite(self._file, line, self._size_bytes) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            os.ftruncate(self._file, self._size_bytes)
            raise self._unwritable(error) from error
        self._size_bytes += len(line)
        self.episodes[episode.key] = episode

    def score(self, version: int, mode: Mode, episodes: int, seed: int) -> Score | None:
        """The score over the first so many episodes, or None while some are missing."""
        keys: list[EpisodeKey] = [(version, mode, number) for number in range(episodes)]
        if any(key not in self.episodes for key in keys):
            return None
        return score_of([self.episodes[key] for key in keys], seed)

    def close(self) -> None:
        """Gives the file free."""
        os.close(self._file)
        self._lock.close()

    def _unwritable(self, error: OSError) -> StorageError:
        return StorageError(
            f"{self._path}: expected a file that can be written; got {error}; "
            "free disk space, or check the folder's permissions"
        )


def read_results(path: Path) -> list[Episode]:
    """The episodes of a results file, also while another process adds to it; empty if none.

    Raises:
        StorageError: The file holds something else.
    """
    return _read(path)[0]


def _read(path: Path) -> tuple[list[Episode], int]:
    """The episodes, and the size in bytes of the whole lines."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return [], 0
    whole = data[: data.rfind(b"\n") + 1]
    try:
        lines = whole.decode().splitlines()
        episodes = [from_plain(json.loads(line), Episode, path.name) for line in lines]
    except ValueError as error:
        raise StorageError(
            f"{path}: expected evaluation episodes; got {error}; move the file away"
        ) from error
    return episodes, len(whole)


# Scoring --------------------------------------------------------------------------------------


def score_of(episodes: Sequence[Episode], seed: int) -> Score:
    """Means and intervals over episodes of one version and mode."""
    returns = tuple(episode.return_ for episode in episodes)
    successes = [float(episode.success) for episode in episodes]
    return Score(
        episodes[0].version,
        episodes[0].mode,
        len(episodes),
        float(np.mean(returns)),
        bootstrap_interval(returns, seed),
        float(np.mean(successes)),
        bootstrap_interval(successes, seed),
        returns,
    )


def scores_of(episodes: Iterable[Episode], seed: int) -> list[Score]:
    """The score of each version and mode that has episodes, by version."""
    grouped: defaultdict[tuple[int, Mode], dict[int, Episode]] = defaultdict(dict)
    for episode in episodes:
        grouped[episode.version, episode.mode][episode.number] = episode
    return [
        score_of([group[n] for n in sorted(group)], seed) for _, group in sorted(grouped.items())
    ]


def bootstrap_interval(
    values: Sequence[float], seed: int, confidence: float = 0.95
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean."""
    generator = np.random.default_rng([seed, EVALUATION_STREAM])
    array = np.asarray(values, float)
    picks = generator.integers(len(array), size=(BOOTSTRAP_SAMPLES, len(array)))
    tail = (1 - confidence) / 2
    low, high = np.quantile(array[picks].mean(axis=1), [tail, 1 - tail])
    return float(low), float(high)
