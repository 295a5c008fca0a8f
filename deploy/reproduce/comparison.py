"""Runs of several methods on the same seeds, in parallel, interruptible, kept as JSON lines."""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch

from broker_config.errors import MessageError, StorageError
from broker_config.preset import Preset
from broker_config.structure import from_plain, to_plain
from deploy.presets import load_preset
from deploy.process import end_with_parent
from deploy.reproduce.learning_curve import CurvePoint, InProcessRun
from learner.checkpoint import CheckpointStore
from learner.compute import Compute

Method = Literal["dpn", "dueling-dpn", "dqn", "dueling-dqn"]
Device = Literal["cpu", "cuda"]

_OVERRIDES: dict[Method, tuple[str, ...]] = {
    "dpn": ("algorithm.method=dpn", "algorithm.head=plain"),
    "dueling-dpn": ("algorithm.method=dpn", "algorithm.head=dueling-penalty"),
    "dqn": ("algorithm.method=dqn", "algorithm.head=plain"),
    "dueling-dqn": ("algorithm.method=dqn", "algorithm.head=dueling-mean"),
}


@dataclass(frozen=True)
class RunKey:
    """Names one run of a comparison."""

    method: Method
    seed: int
    preset_digest: str
    """Of the run's own preset, method and seed included."""

    @property
    def name(self) -> str:
        """Short, and another for every setting."""
        return f"{self.method}-{self.seed}-{self.preset_digest[:12]}"


@dataclass(frozen=True)
class FinishedRun:
    """A learning curve and the run that it belongs to."""

    key: RunKey
    device: Device
    points: tuple[CurvePoint, ...]

    @property
    def samples(self) -> list[int]:
        """Samples at each update."""
        return [samples for point in self.points for samples in point.updated_at]

    @property
    def greedy_returns(self) -> list[float]:
        """Of the policy after each update."""
        return [value for point in self.points for value in point.greedy_returns]


def method_preset(name: str, overrides: Sequence[str], method: Method, seed: int) -> Preset:
    """The preset of one run: a file of `deploy/presets`, changed.

    Raises:
        PresetError: There is no such preset, or an override cannot be used.
    """
    return load_preset(name, (*overrides, *_OVERRIDES[method], f"seed={seed}"))


def finish_runs(
    presets: dict[RunKey, Preset],
    curves: Path,
    work: Path,
    device: Device,
    jobs: int,
    iterations: int,
) -> list[FinishedRun]:
    """Makes what the file does not hold yet, and adds each run to it when it is finished.

    Args:
        presets: The runs, in the order in which they are started.
        curves: The file of JSON lines, one for each iteration of a finished run.
        work: Folder of checkpoints: an unfinished run goes on from its last iteration.
        device: What the learners compute on; actors act on the CPU.
        jobs: Runs at a time, each in a process of its own with one thread.
        iterations: How far each run is followed; a run that was followed less far goes on.

    Returns:
        All runs asked for, in the order of `presets`, with as many iterations each.

    Raises:
        StorageError: The file cannot be read or written.
    """
    finished = {run.key: run for run in read_runs(curves)}
    missing = {
        key: preset
        for key, preset in presets.items()
        if key not in finished or len(finished[key].points) < iterations
    }
    for run in _run_side_by_side(missing, work, device, jobs, iterations):
        finished[run.key] = run
        write_runs(curves, finished.values())
    return [replace(finished[key], points=finished[key].points[:iterations]) for key in presets]


def _run_side_by_side(
    presets: dict[RunKey, Preset], work: Path, device: Device, jobs: int, iterations: int
) -> Iterator[FinishedRun]:
    # A process for each run, and spawned: CUDA does not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        jobs, context, end_with_parent, (os.getpid(),), max_tasks_per_child=1
    ) as pool:
        futures = [
            pool.submit(_run, key, preset, work / key.name, device, iterations)
            for key, preset in presets.items()
        ]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)  # what has not begun does not begin
            raise


def _run(key: RunKey, preset: Preset, folder: Path, device: Device, iterations: int) -> FinishedRun:
    torch.set_num_threads(1)
    run = InProcessRun(preset, CheckpointStore(folder), Compute(device))
    for point in run.finish(iterations):
        line = (
            f"{key.name}: iteration {point.iteration}, greedy {point.greedy_return:.2f}, "
            f"training {point.training_return:.2f}, {point.gradient_steps} gradient steps, "
            f"{point.secs:.1f} s\n"
        )
        sys.stderr.write(line)
    return FinishedRun(key, device, tuple(run.points))


def read_runs(path: Path) -> list[FinishedRun]:
    """Reads what `write_runs` wrote; no runs where there is no file.

    Raises:
        StorageError: The file holds something else.
    """
    if not path.exists():
        return []
    curves: dict[tuple[RunKey, Device], list[CurvePoint]] = {}
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        try:
            row = from_plain(json.loads(line), _Row, f"{path.name}:{number}")
        except (ValueError, MessageError) as error:
            raise StorageError(
                f"{path}: expected learning curves; got line {number}: {error}; move it away"
            ) from error
        curves.setdefault((row.run, row.device), []).append(row.point)
    return [FinishedRun(key, device, tuple(points)) for (key, device), points in curves.items()]


def write_runs(path: Path, runs: Iterable[FinishedRun]) -> None:
    """Writes the runs' curves, ordered by method and seed; a reader sees the whole file or none.

    Raises:
        StorageError: The disk refuses.
    """
    ordered = sorted(runs, key=lambda run: (run.key.method, run.key.seed, run.key.preset_digest))
    rows = [_Row(run.key, run.device, point) for run in ordered for point in run.points]
    text = "".join(json.dumps(to_plain(row)) + "\n" for row in rows)
    partial = path.with_suffix(".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise StorageError(f"{path}: expected to write {len(rows)} lines; got {error}") from error


@dataclass(frozen=True)
class _Row:
    run: RunKey
    device: Device
    point: CurvePoint
