"""One run in one process: collect, update, and score the greedy policy."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np

from actors.acting import collecting_policy
from actors.envs import ClothbusEnv
from actors.networks import weights_to_bytes
from actors.policy import Policy
from actors.rollout import ActingPolicy, collect
from actors.task import make_task_env
from broker_config.closing import Closing
from broker_config.durable import write_durably
from broker_config.errors import PresetError, StorageError
from broker_config.messages import Trajectory, TrajectoryId
from broker_config.preset import DiscriminatorPreset
from broker_config.structure import from_plain, to_plain
from deploy.evaluation.played_episodes import sound_episode
from deploy.evaluation.player import Player
from deploy.reproduce.demonstrations import demonstrations_of
from deploy.reproduce.runs import CLONED, CurvePoint, RunPlan
from deploy.reproduce.work_folder import checkpoints_folder, discriminators_file, policy_file
from deploy.rewards.relabelling import relabel
from discriminator.real_states import real_states
from discriminator.trainer import Discriminators
from learner.checkpoint import CheckpointStore
from learner.cloning import Cloned, clone, cloning_preset
from learner.sqil import add_own, hold_demonstrations
from learner.steps.compute import ON_CPU, Compute
from learner.tickets import make_ticket
from learner.trainer import Trainer, TrainerState, UpdateReport

_DISCRIMINATORS = "discriminators."
"""Before the names of their tensors in a checkpoint."""


class InProcessRun(Closing):
    """A run whose episodes are those that tickets over the bus would ask for.

    It checkpoints after every iteration, and goes on from there when it is made again. Tasks are
    deterministic given the ticket, and policies trail by the preset's lag: a lag is refused here,
    since nothing is collected side by side.

    Attributes:
        points: What was reached so far.
        compute: On what and by which path it trains: the one it was begun with, where no other was
            asked for.
    """

    def __init__(self, plan: RunPlan, work: Path, compute: Compute = ON_CPU) -> None:
        """Begins, or goes on.

        Args:
            plan: Of the run.
            work: Folder for its checkpoints, and for demonstrations.
            compute: What it is trained on.

        Raises:
            StorageError: It was begun on another device, or by another path than is asked for.
            ValueError: The preset has a policy lag.
        """
        preset = plan.preset
        if preset.schedule.policy_lag != 0:
            raise ValueError(
                f"{preset.name}: expected schedule.policy_lag 0; got {preset.schedule.policy_lag}; "
                "one process collects and trains in turn"
            )
        self._plan, self._preset, self._work = plan, preset, work
        self._env: ClothbusEnv | None = None
        self._player: Player | None = None
        self._checkpoints = CheckpointStore(checkpoints_folder(work, plan.key))
        checkpoint = self._checkpoints.latest()
        self.compute = self._as_begun(compute, checkpoint.extra["compute"] if checkpoint else None)
        self._trainer = Trainer(preset, self.compute)
        self._policy: Policy | None = None
        """The current one, once somebody has asked for it."""
        self._cloned: Cloned | None = None
        self._discriminators = self._new_discriminators()
        self.points: list[CurvePoint] = []
        if checkpoint is not None:
            self._restore(checkpoint.state)
            self.points = [
                from_plain(point, CurvePoint, "checkpoint.points")
                for point in checkpoint.extra["points"]
            ]

    def close(self) -> None:
        """Ends the environments."""
        for each in (self._env, self._player):
            if each is not None:
                each.close()
        self._env = self._player = None

    def keep_policy(self) -> Path:
        """Stores the newest policy's weights beside the checkpoints; returns the file."""
        path = policy_file(self._work, self._plan)
        path.parent.mkdir(parents=True, exist_ok=True)
        weights = self._trainer.weights() if self._cloned is None else self._cloned.weights
        write_durably(path, weights_to_bytes(weights))
        return path

    def finish(self, iterations: int | None = None) -> Iterator[CurvePoint]:
        """Runs what is left of so many iterations, or of all; yields each once it is on disk.

        Raises:
            StorageError: No seed gives a sound episode, or the disk refuses.
        """
        last = self._preset.schedule.iterations if iterations is None else iterations
        while not self.points or self.points[-1].iteration < last:
            self.points.append(self._iterate() if self.points else self._begin())
            if self._cloned is None:  # cloning is short, and no trainer's state
                points = [to_plain(point) for point in self.points]
                extra = {"points": points, "compute": str(self.compute)}
                self._checkpoints.save(self._state(), extra)
            yield self.points[-1]

    def _as_begun(self, compute: Compute, begun: str | None) -> Compute:
        try:
            return compute if begun is None else compute.as_begun(begun)
        except StorageError as error:
            raise StorageError(f"{self._plan.key.name}: {error}, or another --work") from error

    def _begin(self) -> CurvePoint:
        """Iteration 0: the untrained policy, or what its start has made of it."""
        began_secs = time.perf_counter()
        demonstrations = self._demonstrations
        report: UpdateReport | None = None
        loss, gradient_steps = None, 0
        if self._plan.key.start == "initialised":
            for each in demonstrations:
                self._add(each)
            report = self._trainer.initialise()
            loss, gradient_steps = report.loss, report.gradient_steps
        if self._preset.algorithm.method == "sqil":
            hold_demonstrations(self._trainer, demonstrations)
        if self._plan.key.start in (*CLONED, "pretrained"):
            epochs = self._cloning_epochs()
            cloned = clone(self._preset, demonstrations, epochs, self._augmentation())
            loss, gradient_steps = cloned.loss, cloned.gradient_steps
            if self._plan.key.start == "pretrained":
                self._go_on_from(cloned)
            else:
                self._cloned = cloned
        greedy_return, success = self._score()
        horizon = self._preset.task.horizon
        returns = [each.return_ for each in demonstrations if each.steps == horizon]
        return CurvePoint(
            iteration=0,
            samples=0,
            gradient_steps=gradient_steps,
            updated_at=(0,),
            greedy_returns=(greedy_return,),
            greedy_successes=(success,),
            training_return=float(np.mean(returns)) if returns else None,
            loss=_finite(loss),
            mean_value=_finite(report.mean_value if report else None),
            bellman_error=_finite(report.bellman_error if report else None),
            relative_bellman_error=_finite(report.relative_bellman_error if report else None),
            secs=time.perf_counter() - began_secs,
        )

    def _iterate(self) -> CurvePoint:
        began_secs = time.perf_counter()
        schedule, n_before = self._preset.schedule, self.points[-1].iteration
        first = n_before * schedule.episodes_per_iteration
        last = first + schedule.episodes_per_iteration - 1
        returns: list[float] = []
        updated_at: list[int] = []
        scores: list[tuple[float, float]] = []
        report: UpdateReport | None = None
        for index in range(first, last + 1):
            acting = collecting_policy(self._preset.algorithm, self._current_policy())
            played = self._collect(acting, index)
            self._add(played)
            returns.append(played.return_)
            if schedule.updates_after(index):
                if self._discriminators is not None:
                    relabel(self._trainer, self._discriminators)
                    self._keep_discriminators(n_before + 1)
                report = self._trainer.update()
                self._policy = None
                if self._plan.key.scored_after == "update" or index == last:
                    updated_at.append((index + 1) * self._preset.task.horizon)
                    scores.append(self._score())
        assert report is not None  # an update ends every iteration
        return CurvePoint(
            iteration=n_before + 1,
            samples=(n_before + 1) * schedule.episodes_per_iteration * self._preset.task.horizon,
            gradient_steps=self._trainer.gradient_steps,
            updated_at=tuple(updated_at),
            greedy_returns=tuple(return_ for return_, _ in scores),
            greedy_successes=tuple(success for _, success in scores),
            training_return=float(np.mean(returns)),
            loss=_finite(report.loss),
            mean_value=_finite(report.mean_value),
            bellman_error=_finite(report.bellman_error),
            relative_bellman_error=_finite(report.relative_bellman_error),
            secs=time.perf_counter() - began_secs,
        )

    @cached_property
    def _demonstrations(self) -> list[Trajectory]:
        return demonstrations_of(self._plan, self._work)

    def _new_discriminators(self) -> Discriminators | None:
        imitation = self._preset.imitation
        has_none = not self._preset.has_discriminators or self._plan.key.start in CLONED
        if imitation is None or has_none:
            return None
        real = real_states(self._demonstrations, imitation.target_reward)
        return Discriminators(self._preset, real)

    def _keep_discriminators(self, iteration: int) -> None:
        """Stores what has labelled the samples: rewards and their maps can be made anew from it."""
        assert self._discriminators is not None
        path = discriminators_file(self._work, self._plan, iteration)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, self._discriminators.weights_bytes())

    def _cloning_epochs(self) -> int:
        """As many as the learner's beside it: of its initialisation, or of all that it imitates.

        What is trained further gets as many as one of its iterations has.
        """
        initialisation, imitation = self._preset.initialisation, self._preset.imitation
        if self._plan.key.start == "pretrained":
            assert imitation is not None
            return imitation.generator_epochs
        if initialisation is not None:
            return initialisation.target_switches * self._preset.schedule.epochs
        assert imitation is not None  # or there were no demonstrations
        return imitation.generator_epochs * self._preset.schedule.iterations

    def _augmentation(self) -> DiscriminatorPreset | None:
        if self._plan.key.start != "cloned-augmented":
            return None
        if self._preset.imitation is None:
            raise PresetError(
                f"{self._preset.name}: expected an [imitation] table, whose discriminators say how "
                "pictures are changed; got none; add it, or clone without augmentation"
            )
        return self._preset.imitation.discriminator

    def _go_on_from(self, cloned: Cloned) -> None:
        """Has the learner begin with a cloned policy; its optimiser is new."""
        state = self._trainer.get_state()
        weights = {f"network.{name}": part for name, part in cloned.weights.items()}
        counters = {**state.counters, "gradient_steps": cloned.gradient_steps}
        self._trainer.set_state(TrainerState({**state.tensors, **weights}, counters))

    def _state(self) -> TrainerState:
        state = self._trainer.get_state()
        if self._discriminators is None:
            return state
        theirs = self._discriminators.get_state()
        tensors = {f"{_DISCRIMINATORS}{name}": part for name, part in theirs.items()}
        return TrainerState({**state.tensors, **tensors}, state.counters)

    def _restore(self, state: TrainerState) -> None:
        of_trainer, of_discriminators = {}, {}
        for name, part in state.tensors.items():
            if name.startswith(_DISCRIMINATORS):
                of_discriminators[name.removeprefix(_DISCRIMINATORS)] = part
            else:
                of_trainer[name] = part
        self._trainer.set_state(TrainerState(of_trainer, state.counters))
        if self._discriminators is not None:
            self._discriminators.set_state(of_discriminators)

    def _current_policy(self) -> Policy:
        if self._policy is None:
            if self._cloned is not None:
                network = cloning_preset(self._preset).network
                self._policy = Policy(network, self._cloned.weights)
            else:
                self._policy = Policy(self._preset.network, self._trainer.weights())
        return self._policy

    def _add(self, played: Trajectory) -> None:
        if self._preset.algorithm.method == "sqil":
            add_own(self._trainer, played)
            return
        self._trainer.add(
            played.observations, played.actions, played.rewards, terminated=played.terminated
        )

    def _collect(self, policy: ActingPolicy, index: int) -> Trajectory:
        """Plays an episode; one that the guard ends is played again on the next seed."""
        if self._env is None:
            self._env = make_task_env(self._preset.task)
        env, id_ = self._env, TrajectoryId("in-process", "in-process", index)

        def play(generation: int) -> Trajectory:
            ticket = make_ticket(self._preset, index, generation=generation)
            return collect(env, policy, ticket, id_)

        return sound_episode(index, play)

    def _score(self) -> tuple[float, float]:
        """Mean return and portion of success of the greedy policy, on seeds of evaluation."""
        if self._player is None:
            self._player = Player(self._preset)
        episodes = [
            self._player.play(self._current_policy(), 0, "greedy", number)
            for number in range(self._plan.key.episodes)
        ]
        return (
            float(np.mean([each.return_ for each in episodes])),
            float(np.mean([each.success for each in episodes])),
        )


def _finite(value: float | None) -> float | None:
    """A number as files keep it: what has diverged is none."""
    return value if value is not None and math.isfinite(value) else None
