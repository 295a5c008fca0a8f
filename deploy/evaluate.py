"""`clothbus evaluate`: scores policy snapshots of a run folder on seeds of their own."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from itertools import starmap
from pathlib import Path

from rich.table import Table

from actors.policy import Policy
from broker_config.errors import PresetError, StorageError
from broker_config.preset import Preset
from deploy.evaluation import Episode, Mode, Results, Score, modes_of, score_of
from deploy.player import Player
from deploy.process import end_with_parent, use_one_torch_thread
from deploy.run_folder import RunFolder
from learner.snapshots import SnapshotStore


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
        AlreadyOwned: Another process evaluates the run.
        PresetError: The mode has no meaning for the method.
        StorageError: A version is not retained, or the file holds something else.
    """
    preset = folder.read_preset()
    if mode not in modes_of(preset.algorithm):
        raise PresetError(
            f"{preset.name}: expected mode greedy; got {mode}; Q has no softmax policy"
        )
    chosen = versions or _first_and_last(folder)
    with Results(folder.evaluation) as results:
        missing = [
            (version, number)
            for version in chosen
            for number in range(episodes)
            if (version, mode, number) not in results.episodes
        ]
        for episode in _played(folder, preset, mode, missing, jobs):
            results.add(episode)
        return [
            score_of([results.episodes[version, mode, n] for n in range(episodes)], preset.seed)
            for version in chosen
        ]


def _played(
    folder: RunFolder, preset: Preset, mode: Mode, missing: Sequence[tuple[int, int]], jobs: int
) -> Iterator[Episode]:
    if jobs == 1 or not missing:
        with closing(_Worker(folder.path, preset, mode)) as worker:
            yield from starmap(worker.play, missing)
        return
    with ProcessPoolExecutor(
        jobs,
        multiprocessing.get_context("spawn"),
        _prepare,
        (os.getpid(), folder.path, preset, mode),
    ) as pool:
        try:
            yield from pool.map(_play, missing)
        except BrokenProcessPool as error:
            raise StorageError(
                "evaluation: expected workers that live; got one that died, its last words are "
                "above; what was played is kept, evaluate again"
            ) from error


def _first_and_last(folder: RunFolder) -> list[int]:
    versions = SnapshotStore(folder.snapshots).versions()
    if len(versions) < 2:
        raise StorageError(f"{folder.snapshots}: expected two policy versions; got {versions}")
    return [versions[0], versions[-1]]


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


# In the worker processes, or in this one ------------------------------------------------------


class _Worker:
    """A player and the policies that it has met."""

    def __init__(self, folder: Path, preset: Preset, mode: Mode) -> None:
        use_one_torch_thread()
        self._preset = preset
        self._mode = mode
        self._snapshots = SnapshotStore(RunFolder(folder).snapshots)
        self._player = Player(preset)
        self._policies: dict[int, Policy] = {}

    def play(self, version: int, number: int) -> Episode:
        """Plays an episode of a version that the folder retains."""
        return self._player.play(self._policy(version), version, self._mode, number)

    def close(self) -> None:
        """Ends the environment."""
        self._player.close()

    def _policy(self, version: int) -> Policy:
        if version not in self._policies:
            weights = self._snapshots.get(version)
            if weights is None:
                retained = ", ".join(map(str, self._snapshots.versions()))
                raise StorageError(f"policy version: expected one of {retained}; got {version}")
            self._policies[version] = Policy.from_bytes(self._preset.network, weights)
        return self._policies[version]


_worker: list[_Worker] = []
"""The one worker of this process, put there by `_prepare`."""


def _prepare(parent_pid: int, folder: Path, preset: Preset, mode: Mode) -> None:
    end_with_parent(parent_pid)
    _worker.append(_Worker(folder, preset, mode))


def _play(task: tuple[int, int]) -> Episode:
    return _worker[0].play(*task)
