"""Who demonstrates: a task's script with mistakes, chance, or a policy under training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from actors.acting import UniformlyRandom, collecting_policy
from actors.demonstrate.acting import scripted_demonstrator
from actors.envs import ClothbusEnv
from actors.rollout import ActingPolicy
from broker_config.errors import PresetError, StorageError
from broker_config.messages import DemonstrationsBegun, Demonstrator, SnapshotPlayed
from broker_config.preset import Preset
from deploy.demonstrations.folder import DemonstrationFolder
from deploy.demonstrations.quality import find_quality
from deploy.run_folder import RunFolder

if TYPE_CHECKING:
    from actors.policy import Policy  # brings torch, which scripts and chance do without


@dataclass(frozen=True)
class ActingDemonstrator:
    """A demonstrator, and what it does."""

    who: Demonstrator
    acting_in: Callable[[ClothbusEnv], ActingPolicy]
    """Makes it for an environment of the task."""

    @property
    def policy_version(self) -> int:
        """Of its tickets."""
        return self.who.snapshot.version if self.who.snapshot else 0

    @property
    def epsilon(self) -> float:
        """Of its tickets."""
        return self.who.snapshot.epsilon if self.who.snapshot else 0.0


def by_script(preset: Preset, mistake_rate: float) -> ActingDemonstrator:
    """The task's script, with a share of its actions random.

    Args:
        preset: Whose task it plays.
        mistake_rate: The share, 0 to 1.

    Raises:
        MessageError: The rate is not from 0 to 1.
    """
    return _scripted(preset, Demonstrator("scripted", mistake_rate))


def by_script_of_quality(
    preset: Preset, path: Path, wanted: float, episodes: int, jobs: int = 1
) -> ActingDemonstrator:
    """The task's script, with as many mistakes as make it as good as is wanted.

    Args:
        preset: Whose task it plays.
        path: Folder of the demonstrations: their rate, or else one that is found now, which takes
            a while.
        wanted: The quality, 0 (chance) to 1 (the script).
        episodes: By which the quality of each rate is measured.
        jobs: Processes that measure it.

    Raises:
        AlreadyOwned: Another process adds to the folder.
        PresetError: See `find_quality`.
        StorageError: The folder holds something else, also demonstrations of another quality.
    """
    with DemonstrationFolder(path) as folder:
        origin = folder.made.origin
    if not isinstance(origin, DemonstrationsBegun):
        return _scripted(preset, find_quality(preset.task, wanted, episodes, jobs))
    kept = origin.demonstrator
    if kept.quality is None or (kept.quality.wanted, kept.quality.episodes) != (wanted, episodes):
        raise StorageError(
            f"{path}: expected demonstrations of quality {wanted:g}, measured over {episodes} "
            f"episodes; got those by {kept}; make them in another folder"
        )
    return _scripted(preset, kept)


def _scripted(preset: Preset, who: Demonstrator) -> ActingDemonstrator:
    def acting_in(env: ClothbusEnv) -> ActingPolicy:
        try:
            return scripted_demonstrator(env, preset.task.n_actions, who.mistake_rate)
        except ValueError as error:
            raise PresetError(
                f"{preset.name}: {error}; demonstrate with --demonstrator random or policy"
            ) from error

    return ActingDemonstrator(who, acting_in)


def by_chance(preset: Preset) -> ActingDemonstrator:
    """Any action of the preset's task, whatever the state."""
    policy = UniformlyRandom(preset.task.n_actions)
    return ActingDemonstrator(Demonstrator("random"), lambda _: policy)


def by_policy(preset: Preset, run: RunFolder, version: int | None = None) -> ActingDemonstrator:
    """A policy of a run, acting as it does there.

    The DPN family samples its softmax policy; DQN is epsilon-greedy, with the epsilon of the first
    episode that acts on the version.

    Args:
        preset: Whose task it plays; it may be another than the run's, with pictures and actions
            alike.
        run: The run's folder.
        version: One that the run has kept; the newest if None.

    Raises:
        PresetError: The policy does not fit the task.
        StorageError: The run has not kept the version.
    """
    from deploy.evaluation.policies import (
        kept_policy,  # brings torch, which scripts and chance do without
    )

    of_run = run.read_preset()
    expected = (preset.task.observation_shape, preset.task.n_actions)
    got = (of_run.task.observation_shape, of_run.task.n_actions)
    if expected != got:
        raise PresetError(
            f"{run.path}: expected a policy for {preset.name}, observations {list(expected[0])} "
            f"and {expected[1]} actions; got one for {list(got[0])} and {got[1]}; name a run of "
            "this task"
        )
    kept = kept_policy(run, of_run, version)
    return by_version(run.run, of_run, kept.version, kept.digest, kept.policy)


def by_version(
    run: str, of_run: Preset, version: int, digest: str, policy: Policy
) -> ActingDemonstrator:
    """A policy acting as it does in the run that it is of.

    Args:
        run: The run's name.
        of_run: Its preset.
        version: Of the policy.
        digest: SHA-256 of its weights.
        policy: Which acts.
    """
    acting = collecting_policy(of_run.algorithm, policy)
    played = SnapshotPlayed(run, version, digest, _epsilon(of_run, version))
    return ActingDemonstrator(Demonstrator("policy", snapshot=played), lambda _: acting)


def _epsilon(preset: Preset, version: int) -> float:
    if preset.exploration is None or not preset.algorithm.is_epsilon_greedy:
        return 0.0
    updates = version + preset.schedule.policy_lag if version else 0
    return preset.exploration.epsilon(preset.schedule.episodes_before(updates))
