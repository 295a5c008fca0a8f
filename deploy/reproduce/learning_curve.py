"""One run in one process: collect, update, and the greedy policy's return after each update."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from actors.acting import Greedy, collecting_policy
from actors.envs import ClothbusEnv
from actors.policy import Policy
from actors.rollout import ActingPolicy, Step, collect, rollout
from actors.task import make_task_env
from broker_config.messages import TrajectoryId
from broker_config.preset import Preset
from broker_config.structure import from_plain, to_plain
from learner.checkpoint import CheckpointStore
from learner.compute import ON_CPU, Compute
from learner.tickets import make_ticket
from learner.trainer import Trainer, UpdateReport


@dataclass(frozen=True)
class CurvePoint:
    """The state of a run after an iteration."""

    iteration: int
    """Counted from 1."""
    samples: int
    gradient_steps: int
    updated_at: tuple[int, ...]
    """Samples of the run at each update of the iteration."""
    greedy_returns: tuple[float, ...]
    """Return of one episode of the greedy policy after each of these updates, without discount."""
    training_return: float
    """Mean return of the iteration's episodes."""
    loss: float
    mean_value: float
    bellman_error: float
    relative_bellman_error: float
    secs: float
    """Wall time of the iteration."""

    @property
    def greedy_return(self) -> float:
        """Of the iteration's last policy."""
        return self.greedy_returns[-1]


class InProcessRun:
    """A run whose episodes are those that tickets over the bus would ask for.

    It checkpoints after every iteration, and goes on from there when it is made again. Tasks are
    deterministic given the ticket, and policies trail by the preset's lag: a lag is refused here,
    since nothing is collected side by side.
    """

    def __init__(
        self, preset: Preset, checkpoints: CheckpointStore, compute: Compute = ON_CPU
    ) -> None:
        if preset.schedule.policy_lag != 0:
            raise ValueError(
                f"{preset.name}: expected schedule.policy_lag 0; got {preset.schedule.policy_lag}; "
                "one process collects and trains in turn"
            )
        self._preset = preset
        self._checkpoints = checkpoints
        self._trainer = Trainer(preset, compute)
        self.points: list[CurvePoint] = []
        if (checkpoint := checkpoints.latest()) is not None:
            self._trainer.set_state(checkpoint.state)
            self.points = [
                from_plain(point, CurvePoint, "checkpoint.points")
                for point in checkpoint.extra["points"]
            ]

    def finish(self, iterations: int | None = None) -> Iterator[CurvePoint]:
        """Runs what is left of so many iterations, or of all; yields each once it is on disk."""
        last = self._preset.schedule.iterations if iterations is None else iterations
        env = make_task_env(self._preset.task)
        try:
            while len(self.points) < last:
                self.points.append(self._iterate(env))
                extra = {"points": [to_plain(point) for point in self.points]}
                self._checkpoints.save(self._trainer.get_state(), extra)
                yield self.points[-1]
        finally:
            env.close()

    def _iterate(self, env: ClothbusEnv) -> CurvePoint:
        began_secs = time.perf_counter()
        schedule, n_before = self._preset.schedule, len(self.points)
        first = n_before * schedule.episodes_per_iteration
        returns: list[float] = []
        updated_at: list[int] = []
        greedy_returns: list[float] = []
        report: UpdateReport | None = None
        policy = self._policy()
        for index in range(first, first + schedule.episodes_per_iteration):
            acting = collecting_policy(self._preset.algorithm, policy)
            returns.append(self._collect(env, acting, index))
            if schedule.updates_after(index):
                report = self._trainer.update()
                policy = self._policy()
                updated_at.append((index + 1) * self._preset.task.horizon)
                greedy_returns.append(self._return(env, Greedy(policy)))
        assert report is not None  # an update ends every iteration
        return CurvePoint(
            iteration=n_before + 1,
            samples=(n_before + 1) * schedule.episodes_per_iteration * self._preset.task.horizon,
            gradient_steps=self._trainer.gradient_steps,
            updated_at=tuple(updated_at),
            greedy_returns=tuple(greedy_returns),
            training_return=float(np.mean(returns)),
            loss=report.loss,
            mean_value=report.mean_value,
            bellman_error=report.bellman_error,
            relative_bellman_error=report.relative_bellman_error,
            secs=time.perf_counter() - began_secs,
        )

    def _policy(self) -> Policy:
        return Policy(self._preset.network, self._trainer.weights())

    def _collect(self, env: ClothbusEnv, policy: ActingPolicy, index: int) -> float:
        """Plays an episode into the memory; returns its return."""
        id_ = TrajectoryId("in-process", "in-process", index)
        played = collect(env, policy, make_ticket(self._preset, index), id_)
        self._trainer.add(
            played.observations, played.actions, played.rewards, terminated=played.terminated
        )
        return played.return_

    def _return(self, env: ClothbusEnv, policy: ActingPolicy) -> float:
        """The return of the run's first episode, in float64 where messages carry float32."""
        steps = rollout(env, policy, make_ticket(self._preset, 0))
        return sum(step.reward for step in steps if isinstance(step, Step))
