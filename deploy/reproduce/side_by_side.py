"""Makes the runs of an experiment side by side; what is stopped goes on where it was."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

from broker_config.errors import StorageError
from deploy.process import end_with_parent, use_one_torch_thread
from deploy.reproduce.runs import (
    CLONED,
    ON_CLONING,
    CurvePoint,
    FinishedRun,
    RunKey,
    RunPlan,
    iterations_of,
    read_runs,
    up_to,
    write_runs,
)
from deploy.reproduce.work_folder import checkpoints_folder, policy_file
from learner.steps.compute import Compute


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

    Runs that learn to demonstrate are made before those that they demonstrate to. Whoever calls it
    holds a lock on the work folder.

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
        ClothbusError: A run has failed; all others were finished before, but for those that it
            would have demonstrated to.
        StorageError: The file cannot be read or written, or the process of a run was killed; what
            was under way goes on next time.
    """
    wanted = {plan.key: iterations_of(plan, iterations) for plan in plans}
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
    demonstrators = list(_missing_demonstrators(missing, work, compute, finished, errors))
    followed |= {plan.key: iterations_of(plan, None) for plan in demonstrators}
    for wave in (demonstrators, missing):
        able = [it for it in wave if it.demonstrator is None or _has_policy(it.demonstrator, work)]
        whole = {plan.key: iterations_of(plan, None) for plan in able}
        for run in _run_side_by_side(able, work, compute, jobs, followed, errors):
            finished[run.key] = run
            write_runs(curves, finished.values())
            # Only now: whatever ends this process before, the run goes on from its last iteration.
            if run.iterations >= whole[run.key]:
                shutil.rmtree(checkpoints_folder(work, run.key), ignore_errors=True)
    if errors:
        raise errors[0]
    return [up_to(finished[plan.key], wanted[plan.key]) for plan in plans]


def _missing_demonstrators(
    plans: Iterable[RunPlan],
    work: Path,
    compute: Compute,
    finished: Mapping[RunKey, FinishedRun],
    errors: list[BaseException],
) -> Iterator[RunPlan]:
    """The runs, each once, that are to demonstrate to these and have left no policy here.

    What has learned elsewhere learns again by the same path: by another it would be another
    demonstrator, and conditions of one seed would not have the same one.
    """
    for plan in {it.demonstrator.key: it.demonstrator for it in plans if it.demonstrator}.values():
        # With a checkpoint its curve may not be in the file yet.
        if _has_policy(plan, work) and not checkpoints_folder(work, plan.key).exists():
            continue
        try:
            begun = finished.get(plan.key)
            by = compute if begun is None else compute.as_begun(begun.compute)
        except StorageError as error:
            errors.append(StorageError(f"{plan.key.name}: {error}"))
        else:
            yield replace(plan, path=by.path)


def _has_policy(plan: RunPlan, work: Path) -> bool:
    return policy_file(work, plan).exists()


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
