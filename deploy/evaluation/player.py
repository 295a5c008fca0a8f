"""Plays evaluation episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from actors.acting import Greedy, Sampled
from actors.cloth.guard import GuardReason
from actors.demonstrate.acting import scripted_demonstrator
from actors.envs.stored_states import read_stored_states
from actors.policy import Policy
from actors.rollout import ActingPolicy, collect
from actors.task import make_task_env
from broker_config.errors import PresetError, StorageError
from broker_config.messages import Ticket, Trajectory, TrajectoryId
from broker_config.preset import Preset
from deploy.evaluation.played_episodes import GUARDED_ATTEMPTS
from deploy.evaluation.scores import EVALUATION_STREAM, Episode, Mode
from learner.tickets import derive_seed

LOST_SIMULATORS = 10
"""A simulator that dies is not the seed's fault, but one seed must not kill simulators for ever."""


class Player:
    """Plays evaluation episodes of a preset's task in an environment of its own.

    All versions and modes play the same seeds. An episode that the guard ends is played again on
    another seed; one whose simulator is lost, on the same. Among stored states there is no other to
    take: there an episode that the guard ends has failed.
    """

    def __init__(self, preset: Preset, stored_states: str | None = None) -> None:
        """Makes the environment.

        Args:
            preset: Whose task is played.
            stored_states: Where given, episode n begins with state n of this file or name.

        Raises:
            PresetError: Task and preset disagree, or the states are not of the task's garment.
        """
        self._preset = preset
        task = preset.task
        if stored_states is not None:
            task = replace(task, options={**task.options, "stored_states": stored_states})
        self._env = make_task_env(task)
        self._starts = [] if stored_states is None else read_stored_states(stored_states).starts()

    def close(self) -> None:
        """Ends the environment."""
        self._env.close()

    def play(
        self,
        policy: Policy,
        version: int,
        mode: Mode,
        number: int,
        on_step: Callable[[], None] = lambda: None,
    ) -> Episode:
        """Plays an episode; whatever `on_step` raises after a step ends it.

        Raises:
            StorageError: No seed gives a sound attempt.
        """
        acting = Greedy(policy) if mode == "greedy" else Sampled(policy)
        trajectory = self.play_by(acting, number, version, on_step)
        return Episode(version, mode, number, trajectory.return_, trajectory.success)

    def play_by(
        self,
        acting: ActingPolicy,
        number: int,
        version: int = 0,
        on_step: Callable[[], None] = lambda: None,
    ) -> Trajectory:
        """Plays an episode with whatever acts; see `play`."""
        for attempt in range(GUARDED_ATTEMPTS):
            trajectory = self._attempt(acting, version, (number, attempt), on_step)
            is_over = self._starts and trajectory.guard != GuardReason.ENGINE_LOST
            if trajectory.guard is None or is_over:
                return trajectory
        raise StorageError(
            f"evaluation episode {number}: expected a sound attempt with one of "
            f"{GUARDED_ATTEMPTS} seeds; got {trajectory.guard}; mend the task or the simulator"
        )

    def script(self) -> ActingPolicy:
        """The task's scripted expert, acting in this environment.

        Raises:
            PresetError: The task has none.
        """
        try:
            return scripted_demonstrator(self._env, self._preset.task.n_actions, mistake_rate=0.0)
        except ValueError as error:
            raise PresetError(f"{self._preset.name}: {error}; it has no script to play") from error

    def _attempt(
        self,
        acting: ActingPolicy,
        version: int,
        number_and_attempt: tuple[int, int],
        on_step: Callable[[], None],
    ) -> Trajectory:
        number, attempt = number_and_attempt
        seed = derive_seed(self._preset.seed, EVALUATION_STREAM + number, attempt, 0)
        ticket = Ticket(number, attempt, 0, seed, version, self._preset.task.horizon, 0.0)
        id_ = TrajectoryId("evaluation", "evaluation", number)
        start = self._starts[number].reset_options if self._starts else None
        for _ in range(LOST_SIMULATORS):
            trajectory = collect(self._env, acting, ticket, id_, on_step, start)
            if trajectory.guard != GuardReason.ENGINE_LOST:
                break
        return trajectory
