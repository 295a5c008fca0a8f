"""Evaluation: how episodes of a policy version are kept and turned into a score."""

from __future__ import annotations

import errno
import json
import os
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from broker_config.closing import Closing
from broker_config.errors import StorageError
from broker_config.ownership import FileLock
from broker_config.preset import AlgorithmPreset
from broker_config.structure import from_plain, to_plain

Mode = Literal["sampled", "greedy"]

EVALUATION_STREAM = 2**31
"""Keeps the seeds of evaluation apart from those of every ticket of the run."""

BOOTSTRAP_SAMPLES = 10_000

EpisodeKey = tuple[int, Mode, int]
"""Policy version, mode, number."""

WAITING_FOR_OWNER = "waiting for the owner"
"""The state of an evaluator that nobody gives policies, as its heartbeats say."""


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
    """The ways in which a method's policy can act, the usual one first; Q has no softmax policy."""
    return ("greedy",) if algorithm.is_epsilon_greedy else ("sampled", "greedy")


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
