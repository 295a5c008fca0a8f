"""The runs of an experiment: what determines them, what came out, and the file that keeps it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

from broker_config.preset import Preset
from broker_config.structure import added, to_plain
from deploy.reproduce.json_lines import read_lines, write_lines
from learner.steps.compute import Compute, TrainingPath

ON_CLONING: Final = "autograd on cpu"
"""What clones are trained by, whatever learners are."""

Start = Literal["untrained", "initialised", "cloned", "cloned-augmented", "pretrained"]
"""How a run begins: with the untrained policy, by Algorithm 2 from demonstrations, or by supervised
learning of demonstrations, of their pictures as they are or changed as discriminators see them. A
run that is cloned learns nothing more; one that is pretrained imitates from there."""

ScoredAfter = Literal["update", "iteration"]
"""When the greedy policy plays: after each update, or after the last one of an iteration."""

CLONED: Final[tuple[Start, ...]] = ("cloned", "cloned-augmented")


@dataclass(frozen=True)
class RunKey:
    """Names one run of an experiment by all that determines it, but for its training path."""

    condition: str
    seed: int
    preset_digest: str
    """Of the run's own preset, condition and seed included."""
    start: Start
    mistake_rate: float | None
    """Of the script, where it demonstrates."""
    episodes: int
    """Of the greedy policy for a score."""
    demonstrator: str | None = added(None)
    """Name of the run whose last policy demonstrates, where one does."""
    scored_after: ScoredAfter = added("update")

    @property
    def name(self) -> str:
        """Short, and another for every setting."""
        digest = hashlib.sha256(json.dumps(to_plain(self), sort_keys=True).encode()).hexdigest()
        return f"{self.condition}-{self.seed}-{digest[:12]}"


@dataclass(frozen=True)
class RunPlan:
    """A run that is to be made."""

    key: RunKey
    preset: Preset
    path: TrainingPath | None = None
    """By which its learner makes gradient steps, where that is what is compared."""
    demonstrator: RunPlan | None = None
    """The run whose last policy demonstrates, where one does; it is made before."""

    def compute(self, asked: Compute) -> Compute:
        """What its learner computes on, where somebody has asked for this."""
        return asked if self.path is None else replace(asked, path=self.path)


@dataclass(frozen=True)
class CurvePoint:
    """The state of a run after an iteration; iteration 0 is what came before the first episode."""

    iteration: int
    samples: int
    """Of the run; demonstrations are not counted."""
    gradient_steps: int
    updated_at: tuple[int, ...]
    """Samples of the run at each update of the iteration that was scored."""
    greedy_returns: tuple[float, ...]
    """Mean return of the greedy policy's episodes after each of these updates, no discount."""
    greedy_successes: tuple[float, ...]
    """Portion of these episodes that succeeded at their end; empty where nobody looked."""
    training_return: float | None
    """Mean return of the iteration's episodes; of the demonstrations before the first."""
    loss: float | None
    mean_value: float | None
    bellman_error: float | None
    relative_bellman_error: float | None
    secs: float
    """Wall time of the iteration."""


@dataclass(frozen=True)
class FinishedRun:
    """A learning curve and the run that it belongs to."""

    key: RunKey
    compute: str
    """On what and by which path it was trained."""
    points: tuple[CurvePoint, ...]

    @property
    def iterations(self) -> int:
        """How far it was followed."""
        return self.points[-1].iteration

    @property
    def samples(self) -> list[int]:
        """Samples at each score."""
        return [samples for point in self.points for samples in point.updated_at]

    @property
    def greedy_returns(self) -> list[float]:
        """Of the policy at each score."""
        return [value for point in self.points for value in point.greedy_returns]

    @property
    def greedy_successes(self) -> list[float]:
        """Of the policy at each score."""
        return [value for point in self.points for value in point.greedy_successes]

    @property
    def training_returns(self) -> list[float | None]:
        """Mean of the episodes of each iteration, as they were played to learn from them."""
        return [point.training_return for point in self.points if point.iteration > 0]

    @property
    def relative_bellman_errors(self) -> list[float | None]:
        """Of the update that ends each iteration; None where it has diverged."""
        return [point.relative_bellman_error for point in self.points if point.iteration > 0]

    @property
    def demonstrated_return(self) -> float | None:
        """Mean of what was demonstrated to it in whole episodes; None if nothing was."""
        first = self.points[0]
        return first.training_return if first.iteration == 0 else None


def finished_runs(
    plans: Sequence[RunPlan], curves: Path, iterations: int | None
) -> list[FinishedRun]:
    """Those of the runs that the file holds, as far as `finish_runs` would follow them."""
    finished = {run.key: run for run in read_runs(curves)}
    wanted = {plan.key: iterations_of(plan, iterations) for plan in plans}
    return [
        up_to(finished[key], n)
        for key, n in wanted.items()
        if key in finished and finished[key].iterations >= n
    ]


def iterations_of(plan: RunPlan, iterations: int | None) -> int:
    """How far a run is followed where so many iterations are asked for, or all."""
    if plan.key.start in CLONED:
        return 0
    planned = plan.preset.schedule.iterations
    return planned if iterations is None else min(planned, iterations)


def up_to(run: FinishedRun, iterations: int) -> FinishedRun:
    """The run as if it had been followed no farther."""
    return replace(run, points=tuple(it for it in run.points if it.iteration <= iterations))


def read_runs(path: Path) -> list[FinishedRun]:
    """Reads what `write_runs` wrote; no runs where there is no file.

    Raises:
        StorageError: The file holds something else.
    """
    curves: dict[tuple[RunKey, str], list[CurvePoint]] = {}
    for row in read_lines(path, _Row, "learning curves"):
        curves.setdefault((row.run, row.compute), []).append(row.point)
    return [FinishedRun(key, compute, tuple(points)) for (key, compute), points in curves.items()]


def write_runs(path: Path, runs: Iterable[FinishedRun]) -> None:
    """Writes the runs' curves, ordered by condition and seed; a reader sees the whole file or none.

    Raises:
        StorageError: The disk refuses.
    """
    ordered = sorted(runs, key=lambda run: (run.key.condition, run.key.seed, run.key.name))
    write_lines(path, [_Row(it.key, it.compute, point) for it in ordered for point in it.points])


@dataclass(frozen=True)
class _Row:
    run: RunKey
    compute: str
    point: CurvePoint
