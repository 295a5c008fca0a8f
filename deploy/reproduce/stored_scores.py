"""Last policies on stored initial states (tables 4.3 and 4.5): played once, kept as JSON lines."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from actors.envs.stored_states import StoredStates, read_stored_states
from broker_config.errors import PresetError
from broker_config.structure import added
from deploy.evaluation.played_episodes import mapped
from deploy.process import use_one_torch_thread
from deploy.reproduce.experiment import Experiment, Panel
from deploy.reproduce.json_lines import read_lines, write_lines
from deploy.reproduce.runs import FinishedRun, RunKey, RunPlan, iterations_of
from deploy.reproduce.work_folder import policy_digest, policy_file


@dataclass(frozen=True)
class StoredScore:
    """How the greedy last policy of a run did from the stored states of one name."""

    run: RunKey
    states_digest: str
    """Of all states of the file: see `StoredStates.digest`."""
    initial_state: str
    successes: tuple[bool, ...]
    """At the end of the episode from each state of that name, in the file's order."""
    returns: tuple[float, ...]
    """No discount."""
    policy: str | None = added(None)
    """SHA-256 of the policy's weights; None where it was not kept yet."""


def score_last_policies(
    experiment: Experiment, runs: Sequence[FinishedRun], kept: Path, work: Path, jobs: int
) -> None:
    """Plays what the file does not hold yet, and adds each run's scores to it when they are there.

    Only panels with stored states are scored, and only runs that were followed to their end.

    Args:
        experiment: Whose runs.
        runs: The finished ones.
        kept: The file of JSON lines, one for each run and name of a state.
        work: Folder in which runs have left their last policies.
        jobs: Processes.

    Raises:
        PresetError: There are no such states, or they are not of the task's garment.
        StorageError: A policy is not there, or the file cannot be read or written.
    """
    ended = {run.key: run.iterations for run in runs}
    scores = read_scores(kept)
    for source, missing in unscored(experiment, scores, work).items():
        plans = [it for it in missing if ended.get(it.key, -1) >= iterations_of(it, None)]
        play = partial(_score, source, work)
        for plan, made in zip(plans, mapped(play, plans, jobs), strict=True):
            place = plan.key, made[0].states_digest
            scores = [it for it in scores if (it.run, it.states_digest) != place] + made
            write_scores(kept, scores)
            portion = np.mean([success for score in made for success in score.successes])
            sys.stderr.write(f"{plan.key.name}: {portion:.0%} from the stored states {source}\n")


def unscored(
    experiment: Experiment, scores: Iterable[StoredScore], work: Path
) -> dict[str, list[RunPlan]]:
    """Runs that are still to be scored, by the name of the states.

    Args:
        experiment: Whose runs.
        scores: That are known. Those of another policy than is there now do not count.
        work: Folder in which runs have left their last policies.

    Raises:
        PresetError: There are no such states.
    """
    known = {(score.run, score.states_digest): score for score in scores}
    missing = {}
    for source, plans in _plans_by_states(experiment).items():
        digest = states_of(source).digest
        missing[source] = [
            plan for plan in plans if not _is_current(known.get((plan.key, digest)), plan, work)
        ]
    return missing


def _is_current(score: StoredScore | None, plan: RunPlan, work: Path) -> bool:
    if score is None or score.policy is None:
        return score is not None
    return policy_digest(policy_file(work, plan)) in (None, score.policy)


def _plans_by_states(experiment: Experiment) -> dict[str, list[RunPlan]]:
    panels: dict[str, list[Panel]] = {}
    for panel in experiment.panels:
        if panel.stored_states is not None:
            panels.setdefault(panel.stored_states, []).append(panel)
    return {
        source: list(replace(experiment, panels=tuple(its)).plans())
        for source, its in panels.items()
    }


def states_of(source: str) -> StoredStates:
    """Stored states by their name or file, for a person who has named them.

    Raises:
        PresetError: There are none.
    """
    try:
        return read_stored_states(source)
    except ValueError as error:
        raise PresetError(str(error)) from error


def _score(source: str, work: Path, plan: RunPlan) -> list[StoredScore]:
    """Plays an episode of a run's last policy from each state."""
    from deploy.evaluation.player import Player  # the parent of several processes needs no torch
    from deploy.reproduce.kept_weights import kept_policy

    use_one_torch_thread()
    states, policy = read_stored_states(source), kept_policy(work, plan)
    digest = policy_digest(policy_file(work, plan))
    with closing(Player(plan.preset, source)) as player:
        episodes = [player.play(policy, 0, "greedy", n) for n in range(len(states.names))]
    return [
        StoredScore(
            plan.key,
            states.digest,
            name,
            tuple(
                it.success for it, its in zip(episodes, states.names, strict=True) if its == name
            ),
            tuple(
                it.return_ for it, its in zip(episodes, states.names, strict=True) if its == name
            ),
            digest,
        )
        for name in dict.fromkeys(states.names)
    ]


def successes_of(scores: Iterable[StoredScore], name: str | None = None) -> NDArray[np.float64]:
    """Successes from the states of one name, or from all of them, f64[seeds, trials].

    Args:
        scores: Of one condition, on the same states.
        name: Of the states; None for all.
    """
    by_seed: dict[int, list[bool]] = {}
    for score in scores:
        if name in (None, score.initial_state):
            by_seed.setdefault(score.run.seed, []).extend(score.successes)
    return np.array([by_seed[seed] for seed in sorted(by_seed)], np.float64)


def read_scores(path: Path) -> list[StoredScore]:
    """Reads what `write_scores` wrote; no scores where there is no file.

    Raises:
        StorageError: The file holds something else.
    """
    return read_lines(path, StoredScore, "scores on stored states")


def write_scores(path: Path, scores: Iterable[StoredScore]) -> None:
    """Writes scores, ordered by condition and seed; a reader sees the whole file or none.

    Raises:
        StorageError: The disk refuses.
    """
    by_run = sorted(scores, key=lambda it: (it.run.condition, it.run.seed, it.run.name))
    write_lines(path, by_run)
