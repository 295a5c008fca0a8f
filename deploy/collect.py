"""Demonstrations: episodes of a script or of chance, kept in a journal of their own.

Without a learner, whoever collects owns the journal. Its tickets, attempts and guards work as they
do in a run, and `clothbus run --demonstrations` reads it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Literal

from actors.acting import UniformlyRandom
from actors.demonstrate.acting import scripted_demonstrator
from actors.envs import ClothbusEnv
from actors.rollout import ActingPolicy
from actors.task import make_task_env
from broker_config.errors import PresetError
from broker_config.journal import Journal
from broker_config.messages import SnapshotTaken, Trajectory
from broker_config.ownership import own_run
from broker_config.preset import Preset
from deploy.in_process import InProcessActor
from deploy.run_folder import prepare_run_folder
from learner.owner import Owner
from learner.snapshots import SnapshotStore

Demonstrator = Literal["scripted", "random"]

MANY = 1_000_000
"""Episodes; more than anybody demonstrates."""


def collect_demonstrations(
    preset: Preset,
    output: Path,
    episodes: int,
    demonstrator: Demonstrator,
    random_rate: float,
) -> Iterator[Trajectory]:
    """Plays episodes into the journal of folder `output`; a second call continues it.

    Args:
        preset: Whose task is played.
        output: The folder.
        episodes: How many there shall be in the end.
        demonstrator: Who acts.
        random_rate: Share of the script's actions that are replaced by random ones.

    Yields:
        Each accepted trajectory, once it is on disk.

    Raises:
        PresetError: The task has no script.
        StorageError: The folder holds something else, also those of another demonstrator.
    """
    folder = prepare_run_folder(output, _collecting(preset, demonstrator, random_rate))
    with (
        own_run(folder.path),
        Journal(folder.journal) as journal,
        closing(make_task_env(preset.task)) as env,
    ):
        policy = _policy(env, preset, demonstrator, random_rate)
        owner = Owner(folder.run, folder.read_preset(), journal)
        owner.policy_ready(SnapshotTaken(0, demonstrator, 0))
        actor = InProcessActor(owner, env, SnapshotStore(folder.snapshots), policy)
        for index in range(episodes):
            while not owner.is_ready(index):
                actor.play_until_ready(index)
            yield from owner.trajectories(index)


def _collecting(preset: Preset, demonstrator: Demonstrator, random_rate: float) -> Preset:
    """The preset with a schedule in which every episode acts on version 0: nothing is learned.

    Its name tells the demonstrator, so that a folder never mixes two; the number of episodes is no
    part of it, so that more can be collected later.
    """
    schedule = dataclasses.replace(
        preset.schedule, iterations=MANY, episodes_per_iteration=1, policy_lag=MANY
    )
    name = f"{preset.name}-{demonstrator}-{random_rate:g}"
    return dataclasses.replace(preset, name=name, schedule=schedule)


def _policy(
    env: ClothbusEnv, preset: Preset, demonstrator: Demonstrator, random_rate: float
) -> ActingPolicy:
    if demonstrator == "random":
        return UniformlyRandom(preset.task.n_actions)
    try:
        return scripted_demonstrator(env, preset.task.n_actions, random_rate)
    except ValueError as error:
        raise PresetError(f"{preset.name}: {error}; collect with --demonstrator random") from error
