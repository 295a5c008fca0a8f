"""The runs of an experiment: made side by side, resumable, and kept as JSON lines."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence, Set
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final, Literal

from broker_config.errors import StorageError
from broker_config.preset import Preset
from deploy.process import end_with_parent, use_one_torch_thread
from deploy.reproduce.json_lines import read_lines, write_lines
from learner.steps.compute import Compute, TrainingPath

ON_CLONING: Final = "autograd on cpu"
"""What clones are trained by, whatever learners are."""

Start = Literal["untrained", "initialised", "cloned", "cloned-augmented", "pretrained"]
"""How a run begins: with the untrained policy, by Algorithm 2 from demonstrations, or by supervised
learning of demonstrations, of their pictures as they are or changed as discriminators see them. A
run that is cloned learns nothing more; one that is pretrained imitates from there."""

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
    """Of the demonstrator, where there is one."""
    episodes: int
    """Of the greedy policy after each update."""

    @property
    def name(self) -> str:
        """Short, and another for every setting."""
        digest = hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()
        return f"{self.condition}-{self.seed}-{digest[:12]}"


@dataclass(frozen=True)
class RunPlan:
    """A run that is to be made."""

    key: RunKey
    preset: Preset
    path: TrainingPath | None = None
    """By which its learner makes gradient steps, where that is what is compared."""

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
    """Samples of the run at each update of the iteration."""
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
        """Samples at each update."""
        return [samples for point in self.points for samples in point.updated_at]

    @property
    def greedy_returns(self) -> list[float]:
        """Of the policy after each update."""
        return [value for point in self.points for value in point.greedy_returns]

    @property
    def greedy_successes(self) -> list[float]:
        """Of the policy after each update."""
        return [value for point in self.points for value in point.greedy_successes]

    @property
    def demonstrated_return(self) -> float | None:
        """Mean of what was demonstrated to it in whole episodes; None if nothing was."""
        first = self.points[0]
        return first.training_return if first.iteration == 0 else None


def finish_runs(
    plans: Sequence[RunPlan],
    curves: Path,
    work: Path,
    compute: Compute,
    jobs: int,
    iterations: int | None,
    anew: Set[RunKey] = frozenset(),
) -> list[FinishedRun]:
    """Makes what the file does not hold yet, and adds each run to it when it is finished.

    Whoever calls it holds a lock on the work folder.

    Args:
        plans: The runs, in the order in which they are started.
        curves: The file of JSON lines, one for each iteration of a finished run.
        work: Folder of checkpoints and demonstrations: an unfinished run goes on from its last
            iteration.
        compute: What the learners compute on; actors act on the CPU.
        jobs: Runs at a time, each in a process of its own with one thread.
        iterations: How far each run is followed; the preset's if None. A run that was followed less
            far goes on.
        anew: Runs that are made again though the file holds them, as far as it does.

    Returns:
        All runs asked for, in the order of `plans`.

    Raises:
        ClothbusError: A run has failed; all others were finished before.
        StorageError: The file cannot be read or written, or the process of a run was killed; what
            was under way goes on next time.
    """
    wanted = {plan.key: iterations_of(plan, iterations) for plan in plans}
    whole = {plan.key: iterations_of(plan, None) for plan in plans}
    finished = {run.key: run for run in read_runs(curves)}
    followed = dict(wanted)
    missing = []
    for plan in plans:
        kept = finished.get(plan.key)
        if kept is not None and plan.key in anew:
            followed[plan.key] = max(wanted[plan.key], kept.iterations)
        if kept is None or kept.iterations < wanted[plan.key] or plan.key in anew:
            missing.append(plan)
        elif kept.compute not in (str(plan.compute(compute)), ON_CLONING):
            sys.stderr.write(f"{plan.key.name}: kept as it is, by {kept.compute}\n")
    errors: list[BaseException] = []
    for run in _run_side_by_side(missing, work, compute, jobs, followed, errors):
        finished[run.key] = run
        write_runs(curves, finished.values())
        # Only now: whatever ends this process before, the run goes on from its last iteration.
        if run.iterations >= whole[run.key]:
            shutil.rmtree(checkpoints_folder(work, run.key), ignore_errors=True)
    if errors:
        raise errors[0]
    return [_up_to(finished[plan.key], wanted[plan.key]) for plan in plans]


def finished_runs(
    plans: Sequence[RunPlan], curves: Path, iterations: int | None
) -> list[FinishedRun]:
    """Those of the runs that the file holds, as far as `finish_runs` would follow them."""
    finished = {run.key: run for run in read_runs(curves)}
    wanted = {plan.key: iterations_of(plan, iterations) for plan in plans}
    return [
        _up_to(finished[key], n)
        for key, n in wanted.items()
        if key in finished and finished[key].iterations >= n
    ]


def checkpoints_folder(work: Path, key: RunKey) -> Path:
    """Where an unfinished run keeps what it goes on from."""
    return work / "checkpoints" / key.name


def iterations_of(plan: RunPlan, iterations: int | None) -> int:
    """How far a run is followed where so many iterations are asked for, or all."""
    if plan.key.start in CLONED:
        return 0
    planned = plan.preset.schedule.iterations
    return planned if iterations is None else min(planned, iterations)


def _up_to(run: FinishedRun, iterations: int) -> FinishedRun:
    return replace(run, points=tuple(it for it in run.points if it.iteration <= iterations))


def _run_side_by_side(
    plans: Sequence[RunPlan],
    work: Path,
    compute: Compute,
    jobs: int,
    followed: dict[RunKey, int],
    errors: list[BaseException],
) -> Iterator[FinishedRun]:
    """Yields each run when it is finished; one that fails does not end the others.

    Raises:
        StorageError: A process was killed, which ends all of them.
    """
    # A process for each run, and spawned: CUDA does not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        jobs, context, end_with_parent, (os.getpid(),), max_tasks_per_child=1
    ) as pool:
        futures = {
            pool.submit(_run, plan, work, plan.compute(compute), followed[plan.key]): plan.key
            for plan in plans
        }
        try:
            for number, future in enumerate(as_completed(futures), start=1):
                error = future.exception()
                if isinstance(error, BrokenProcessPool):
                    raise StorageError(
                        f"{work}: expected processes that live; got one that was killed, perhaps "
                        "for want of memory; run the command again, it goes on from there"
                    ) from error
                ending = "finished" if error is None else f"failed: {error}"
                name = futures[future].name
                sys.stderr.write(f"{number} of {len(futures)} runs: {name} {ending}\n")
                if error is None:
                    yield future.result()
                else:
                    errors.append(error)
        except BaseException:
            pool.shutdown(cancel_futures=True)  # what has not begun does not begin
            raise


def _run(plan: RunPlan, work: Path, compute: Compute, iterations: int) -> FinishedRun:
    from deploy.reproduce.in_process_run import InProcessRun  # the parent needs no torch

    use_one_torch_thread()
    with InProcessRun(plan, work, compute) as run:
        for point in run.finish(iterations):
            sys.stderr.write(f"{plan.key.name}: {_described(point)}\n")
        if run.points[-1].iteration >= iterations_of(plan, None):
            run.keep_policy()
        made_by = ON_CLONING if plan.key.start in CLONED else str(run.compute)
        return FinishedRun(plan.key, made_by, tuple(run.points))


def _described(point: CurvePoint) -> str:
    success = f", success {point.greedy_successes[-1]:.0%}" if point.greedy_successes else ""
    return (
        f"iteration {point.iteration}, greedy {point.greedy_returns[-1]:.2f}{success}, "
        f"{point.gradient_steps} gradient steps, {point.secs:.1f} s"
    )


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
