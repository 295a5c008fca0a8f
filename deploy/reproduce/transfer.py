"""Last policies in worlds that they have not learned in: played once, kept as JSON lines."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import closing, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from actors.acting import Greedy, UniformlyRandom
from actors.rollout import ActingPolicy
from broker_config.errors import ClothbusError, StorageError
from broker_config.ownership import FileLock
from broker_config.preset import with_settings
from deploy.evaluation.played_episodes import mapped
from deploy.evaluation.player import Player
from deploy.process import use_one_torch_thread
from deploy.reproduce.catalogue import find_experiment
from deploy.reproduce.experiment import KeptPolicies, TransferTable
from deploy.reproduce.json_lines import read_lines, write_lines
from deploy.reproduce.kept_weights import kept_policy
from deploy.reproduce.runs import RunPlan
from deploy.reproduce.work_folder import policy_digest, policy_file

SCRIPT: Final = "the script"
CHANCE: Final = "chance"


@dataclass(frozen=True)
class Trial:
    """Somebody who is tested in a world: a run's last policy, the task's script, or chance."""

    experiment: str
    panel: str
    player: str
    """A condition, `SCRIPT` or `CHANCE`."""
    run: str
    """Its name; for script and chance, that of the run whose starts they have."""
    seed: int
    world: tuple[str, ...]
    """The settings that make it."""
    episodes: int


@dataclass(frozen=True)
class WorldScore:
    """What came of a trial."""

    trial: Trial
    policy: str | None
    """SHA-256 of the policy's weights; None for script and chance."""
    successes: tuple[bool, ...]
    """At the end of each episode."""
    returns: tuple[float, ...]
    """No discount."""


@dataclass(frozen=True)
class _Planned:
    trial: Trial
    plan: RunPlan
    weights: Path | None
    """The policy's file, which need not be there; None for script and chance."""

    def can_be_played(self) -> bool:
        """Whether there is all that it takes."""
        return self.weights is None or self.weights.exists()

    def is_answered_by(self, score: WorldScore | None) -> bool:
        """Whether a score is one of this trial, by the policy that is there now."""
        if score is None:
            return False
        return self.weights is None or policy_digest(self.weights) in (None, score.policy)


def score_worlds(
    table: TransferTable, kept: Path, work: Path, jobs: int, *, draw_only: bool = False
) -> list[WorldScore]:
    """Plays what the file does not hold yet; adds each score to it when it is there.

    What the file holds of trials that the table no longer has stays in it, and is not returned.

    Args:
        table: What is tested, and where.
        kept: The file of JSON lines.
        work: Folder in which experiments keep their runs' last policies; those that are not there
            are left out.
        jobs: Processes.
        draw_only: Play nothing.

    Returns:
        The scores of the table's trials, as many as there are, in its order.

    Raises:
        AlreadyOwned: Another process makes them in the work folder; what is there can be drawn.
        ClothbusError: A trial has failed; all others were played before.
        StorageError: There is no score, and no policy to make one of; or the file cannot be read or
            written.
    """
    planned = list(_planned(table, work))
    lock = partial(FileLock, work / f"{table.name}.lock", f"{table.name} in {work}")
    with nullcontext() if draw_only else lock():
        scores = {score.trial: score for score in read_lines(kept, WorldScore, "scores in worlds")}
        missing = [
            it
            for it in _with_their_references(planned)
            if not draw_only and not it.is_answered_by(scores.get(it.trial))
        ]
        asked = {it.trial for it in planned}
        errors: list[ClothbusError] = []
        for it, made in zip(missing, mapped(partial(_try, work), missing, jobs), strict=True):
            if isinstance(made, ClothbusError):
                errors.append(made)
                sys.stderr.write(f"{_described(it.trial)} failed: {made}\n")
                continue
            scores[it.trial] = made
            others = [it for trial, it in scores.items() if trial not in asked]
            write_lines(kept, [*_of_table(planned, scores), *others])
            sys.stderr.write(f"{_described(it.trial)}: {np.mean(made.successes):.0%}\n")
    if errors:
        raise errors[0]
    if not (found := _of_table(planned, scores)):
        names = ", ".join(dict.fromkeys(it.experiment for it in table.policies))
        raise StorageError(
            f"{work}: expected last policies of {names}; got none; run one of them first, with the "
            "same --work"
        )
    return found


def _of_table(planned: list[_Planned], scores: Mapping[Trial, WorldScore]) -> list[WorldScore]:
    return [scores[it.trial] for it in planned if it.trial in scores]


def _with_their_references(planned: list[_Planned]) -> list[_Planned]:
    """What can be played; script and chance only beside a policy."""
    places = {
        (it.trial.experiment, it.trial.panel) for it in planned if it.weights and it.can_be_played()
    }
    return [
        it
        for it in planned
        if it.can_be_played() and (it.trial.experiment, it.trial.panel) in places
    ]


def _described(trial: Trial) -> str:
    where = " ".join(trial.world) or "as trained"
    return f"{trial.panel}, {trial.player}, seed {trial.seed}, {where}"


def _planned(table: TransferTable, work: Path) -> Iterator[_Planned]:
    for policies in table.policies:
        for world in table.worlds:
            yield from _planned_in(policies, world.overrides, table.episodes, work)


def _planned_in(
    policies: KeptPolicies, world: tuple[str, ...], episodes: int, work: Path
) -> Iterator[_Planned]:
    experiment = find_experiment(policies.experiment)
    (panel,) = [it for it in experiment.panels if it.title == policies.panel]
    place = partial(
        Trial, experiment=experiment.name, panel=panel.title, world=world, episodes=episodes
    )
    for condition in panel.conditions:
        if condition.name in policies.conditions:
            for seed in panel.seed_numbers:
                plan = experiment.plan(panel, condition, seed)
                trial = place(player=condition.name, run=plan.key.name, seed=seed)
                yield _Planned(trial, plan, policy_file(work / experiment.name, plan))
    first = experiment.plan(panel, panel.conditions[0], panel.first_seed)
    for player in (SCRIPT, CHANCE):
        yield _Planned(place(player=player, run=first.key.name, seed=panel.first_seed), first, None)


def _try(work: Path, planned: _Planned) -> WorldScore | ClothbusError:
    try:
        return _play(work, planned)
    except ClothbusError as error:
        return error


def _play(work: Path, planned: _Planned) -> WorldScore:
    use_one_torch_thread()
    trial, preset = planned.trial, with_settings(planned.plan.preset, planned.trial.world)
    with closing(Player(preset)) as player:
        acting: ActingPolicy
        if trial.player == SCRIPT:
            acting = player.script()
        elif trial.player == CHANCE:
            acting = UniformlyRandom(preset.task.n_actions)
        else:
            acting = Greedy(kept_policy(work / trial.experiment, planned.plan))
        episodes = [player.play_by(acting, number) for number in range(trial.episodes)]
    return WorldScore(
        trial,
        None if planned.weights is None else policy_digest(planned.weights),
        tuple(it.success for it in episodes),
        tuple(it.return_ for it in episodes),
    )
