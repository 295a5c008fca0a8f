"""Scores policy snapshots of a run on seeds of their own, with bootstrap intervals."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from rich.table import Table

from actors.acting import Greedy, Sampled
from actors.envs import ClothbusEnv
from actors.policy import Policy
from actors.rollout import ActingPolicy, collect
from actors.task import make_task_env
from broker_config.errors import PresetError, StorageError
from broker_config.messages import Ticket, TrajectoryId
from broker_config.preset import Preset
from broker_config.structure import from_plain, to_plain
from deploy.process import end_with_parent, use_one_torch_thread
from deploy.run_folder import RunFolder
from learner.snapshots import SnapshotStore
from learner.tickets import derive_seed

Mode = Literal["sampled", "greedy"]

EVALUATION_STREAM = 2**31
"""Keeps the seeds of evaluation apart from those of every ticket of the run."""

BOOTSTRAP_SAMPLES = 10_000
GUARDED_ATTEMPTS = 20


@dataclass(frozen=True)
class Episode:
    """The result of one evaluation episode."""

    version: int
    mode: Mode
    number: int
    """Names the episode's seed."""
    return_: float
    success: bool


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


def evaluate(
    folder: RunFolder, versions: Sequence[int], episodes: int, mode: Mode, jobs: int
) -> list[Score]:
    """Plays episodes with each version; each is a line of the folder's `evaluation.jsonl`.

    All versions play the same seeds. Episodes that are in the file already are not played again, so
    that an interrupted evaluation goes on where it was.

    Args:
        folder: Of the run.
        versions: Policy versions that the folder retains; empty for the first and the last.
        episodes: For each version.
        mode: Whether actions are sampled from the policy or the preferred ones.
        jobs: Processes.

    Raises:
        PresetError: The mode has no meaning for the method.
        StorageError: A version is not retained, or the file holds something else.
    """
    preset = folder.read_preset()
    if mode == "sampled" and preset.algorithm.method == "dqn":
        raise PresetError(
            f"{preset.name}: expected mode greedy; got sampled; Q has no softmax policy"
        )
    chosen = versions or _first_and_last(folder)
    played = {(it.version, it.mode, it.number): it for it in _read(folder.evaluation)}
    missing = [
        (version, number)
        for version in chosen
        for number in range(episodes)
        if (version, mode, number) not in played
    ]
    with (
        folder.evaluation.open("a") as results,
        ProcessPoolExecutor(
            jobs,
            multiprocessing.get_context("spawn"),
            _prepare,
            (os.getpid(), folder.path, preset, mode),
        ) as pool,
    ):
        try:
            for episode in pool.map(_play, missing):
                results.write(json.dumps(to_plain(episode)) + "\n")
                results.flush()
                played[episode.version, mode, episode.number] = episode
        except BrokenProcessPool as error:
            raise StorageError(
                "evaluation: expected workers that live; got one that died, its last words are "
                "above; what was played is kept, evaluate again"
            ) from error
    return [
        _score([played[version, mode, number] for number in range(episodes)], preset.seed)
        for version in chosen
    ]


def _read(path: Path) -> list[Episode]:
    if not path.exists():
        return []
    whole, _, torn = path.read_text().rpartition("\n")
    if torn:  # its process died while writing it
        path.write_text(whole + "\n" if whole else "")
    try:
        return [from_plain(json.loads(line), Episode, path.name) for line in whole.splitlines()]
    except ValueError as error:
        raise StorageError(
            f"{path}: expected evaluation episodes; got {error}; move the file away"
        ) from error


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


def _first_and_last(folder: RunFolder) -> list[int]:
    versions = SnapshotStore(folder.snapshots).versions()
    if len(versions) < 2:
        raise StorageError(f"{folder.snapshots}: expected two policy versions; got {versions}")
    return [versions[0], versions[-1]]


def _score(episodes: Sequence[Episode], seed: int) -> Score:
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


def score_table(scores: Sequence[Score]) -> Table:
    """The scores as a table for a terminal."""
    table = Table("policy version", "mode", "episodes", "return", "95 %", "success", "95 %")
    for score in scores:
        low, high = score.return_interval
        rate_low, rate_high = score.success_interval
        table.add_row(
            str(score.version),
            score.mode,
            str(score.episodes),
            f"{score.mean_return:.3f}",
            f"{low:.3f} to {high:.3f}",
            f"{score.success_rate:.0%}",
            f"{rate_low:.0%} to {rate_high:.0%}",
        )
    return table


# In the worker processes ----------------------------------------------------------------------


class _Worker:
    """One process's environment and policies."""

    def __init__(self, folder: Path, preset: Preset, mode: Mode) -> None:
        use_one_torch_thread()
        self._preset = preset
        self._mode = mode
        self._snapshots = SnapshotStore(RunFolder(folder).snapshots)
        self._env: ClothbusEnv = make_task_env(preset.task)
        self._policies: dict[int, ActingPolicy] = {}

    def play(self, version: int, episode: int) -> Episode:
        """Plays an episode; one that the guard ends is played again on another seed."""
        policy = self._policy(version)
        for attempt in range(GUARDED_ATTEMPTS):
            seed = derive_seed(self._preset.seed, EVALUATION_STREAM + episode, attempt, 0)
            ticket = Ticket(episode, attempt, 0, seed, version, self._preset.task.horizon, 0.0)
            id_ = TrajectoryId("evaluation", "evaluation", episode)
            trajectory = collect(self._env, policy, ticket, id_)
            if trajectory.guard is None:
                score = trajectory.return_, trajectory.success
                return Episode(version, self._mode, episode, *score)
        raise StorageError(
            f"evaluation episode {episode}: expected a sound attempt with one of "
            f"{GUARDED_ATTEMPTS} seeds; got {trajectory.guard}; mend the task or the simulator"
        )

    def _policy(self, version: int) -> ActingPolicy:
        if version not in self._policies:
            weights = self._snapshots.get(version)
            if weights is None:
                retained = ", ".join(map(str, self._snapshots.versions()))
                raise StorageError(f"policy version: expected one of {retained}; got {version}")
            policy = Policy.from_bytes(self._preset.network, weights)
            self._policies[version] = Greedy(policy) if self._mode == "greedy" else Sampled(policy)
        return self._policies[version]


_worker: list[_Worker] = []
"""The one worker of this process, put there by `_prepare`."""


def _prepare(parent_pid: int, folder: Path, preset: Preset, mode: Mode) -> None:
    end_with_parent(parent_pid)
    _worker.append(_Worker(folder, preset, mode))


def _play(task: tuple[int, int]) -> Episode:
    return _worker[0].play(*task)
