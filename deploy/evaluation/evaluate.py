"""`clothbus evaluate`: scores policy snapshots of a run folder on seeds of their own."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path

from rich.table import Table

from actors.envs.stored_states import read_stored_states
from actors.policy import Policy
from broker_config.errors import PresetError, StorageError
from broker_config.preset import Preset
from deploy.evaluation.player import Player
from deploy.evaluation.scores import Episode, Mode, Results, Score, modes_of, score_of
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
    what = _Evaluation(folder.path, _checked_preset(folder, mode), mode)
    chosen = versions or _first_and_last(folder)
    with Results(folder.evaluation) as results:
        _play_missing(what, results, chosen, range(episodes), jobs)
        return [_score(what, results, version, range(episodes)) for version in chosen]


def evaluate_on_stored_states(
    folder: RunFolder,
    versions: Sequence[int],
    source: str,
    names: Sequence[str],
    mode: Mode,
    jobs: int,
    episodes: int | None = None,
) -> dict[str, list[Score]]:
    """Plays an episode from each stored state with each version, as `evaluate` does from seeds.

    Results are kept in a file of the folder that belongs to these states alone.

    Args:
        folder: Of the run.
        versions: Policy versions that the folder retains; empty for the first and the last.
        source: See `actors.envs.stored_states.read_stored_states`.
        names: Of the initial states; empty for all that are stored.
        mode: Whether actions are sampled from the policy or the preferred ones.
        jobs: Processes.
        episodes: Play so many states of each name, the first ones; None for all of them.

    Returns:
        The versions' scores by name.

    Raises:
        AlreadyOwned: Another process evaluates the run on these states.
        PresetError: The mode has no meaning for the method, or there are no such states, or too few
            of them, or they are not of the task's garment.
        StorageError: A version is not retained, or the file holds something else.
    """
    preset = _checked_preset(folder, mode)
    try:
        states = read_stored_states(source)
    except ValueError as error:
        raise PresetError(str(error)) from error
    numbers = _stored_numbers(states.names, names, episodes)
    what = _Evaluation(folder.path, preset, mode, source)
    chosen = versions or _first_and_last(folder)
    with Results(folder.stored_evaluation(states.digest)) as results:
        _play_missing(what, results, chosen, [n for them in numbers.values() for n in them], jobs)
        return {
            name: [_score(what, results, version, them) for version in chosen]
            for name, them in numbers.items()
        }


@dataclass(frozen=True)
class _Evaluation:
    """What a worker has to know."""

    folder: Path
    preset: Preset
    mode: Mode
    stored_states: str | None = None


def _checked_preset(folder: RunFolder, mode: Mode) -> Preset:
    preset = folder.read_preset()
    if mode not in modes_of(preset.algorithm):
        raise PresetError(
            f"{preset.name}: expected mode greedy; got {mode}; Q has no softmax policy"
        )
    return preset


def _stored_numbers(
    stored: Sequence[str], names: Sequence[str], episodes: int | None
) -> dict[str, list[int]]:
    """Which states to play, by name."""
    numbers = {
        name: [number for number, its_name in enumerate(stored) if its_name == name]
        for name in dict.fromkeys(names or stored)
    }
    for name, them in numbers.items():
        if len(them) < (episodes or 1):
            raise PresetError(
                f"stored states: expected at least {episodes or 1} {name}; got {len(them)}; there "
                f"are {', '.join(dict.fromkeys(stored))}, and `clothbus states` makes more"
            )
    return {name: them[:episodes] for name, them in numbers.items()}


def _play_missing(
    what: _Evaluation,
    results: Results,
    versions: Sequence[int],
    numbers: Sequence[int],
    jobs: int,
) -> None:
    missing = [
        (version, number)
        for version in versions
        for number in numbers
        if (version, what.mode, number) not in results.episodes
    ]
    for episode in _played(what, missing, jobs):
        results.add(episode)


def _score(what: _Evaluation, results: Results, version: int, numbers: Sequence[int]) -> Score:
    return score_of([results.episodes[version, what.mode, n] for n in numbers], what.preset.seed)


def _played(what: _Evaluation, missing: Sequence[tuple[int, int]], jobs: int) -> Iterator[Episode]:
    if jobs == 1 or not missing:
        with closing(_Worker(what)) as worker:
            yield from starmap(worker.play, missing)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _prepare, (os.getpid(), what)) as pool:
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


_COLUMNS = ("policy version", "mode", "episodes", "return", "95 %", "success", "95 %")


def score_table(scores: Sequence[Score]) -> Table:
    """The scores as a table for a terminal."""
    table = Table(*_COLUMNS)
    for score in scores:
        table.add_row(*_cells(score))
    return table


def stored_score_table(scores: Mapping[str, Sequence[Score]]) -> Table:
    """The scores by initial state as a table for a terminal."""
    table = Table("initial state", *_COLUMNS)
    for name, them in scores.items():
        for score in them:
            table.add_row(name, *_cells(score))
    return table


def _cells(score: Score) -> tuple[str, ...]:
    low, high = score.return_interval
    rate_low, rate_high = score.success_interval
    return (
        str(score.version),
        score.mode,
        str(score.episodes),
        f"{score.mean_return:.3f}",
        f"{low:.3f} to {high:.3f}",
        f"{score.success_rate:.0%}",
        f"{rate_low:.0%} to {rate_high:.0%}",
    )


# In the worker processes, or in this one ------------------------------------------------------


class _Worker:
    """A player and the policies that it has met."""

    def __init__(self, what: _Evaluation) -> None:
        use_one_torch_thread()
        self._what = what
        self._snapshots = SnapshotStore(RunFolder(what.folder).snapshots)
        self._player = Player(what.preset, what.stored_states)
        self._policies: dict[int, Policy] = {}

    def play(self, version: int, number: int) -> Episode:
        """Plays an episode of a version that the folder retains."""
        return self._player.play(self._policy(version), version, self._what.mode, number)

    def close(self) -> None:
        """Ends the environment."""
        self._player.close()

    def _policy(self, version: int) -> Policy:
        if version not in self._policies:
            weights = self._snapshots.get(version)
            if weights is None:
                retained = ", ".join(map(str, self._snapshots.versions()))
                raise StorageError(f"policy version: expected one of {retained}; got {version}")
            self._policies[version] = Policy.from_bytes(self._what.preset.network, weights)
        return self._policies[version]


_worker: list[_Worker] = []
"""The one worker of this process, put there by `_prepare`."""


def _prepare(parent_pid: int, what: _Evaluation) -> None:
    end_with_parent(parent_pid)
    _worker.append(_Worker(what))


def _play(task: tuple[int, int]) -> Episode:
    return _worker[0].play(*task)
