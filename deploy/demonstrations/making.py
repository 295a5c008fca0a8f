"""Makes demonstrations: episode k is a function of ticket k, so that killed work goes on."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Final

from actors.envs import ClothbusEnv
from actors.rollout import ActingPolicy, collect
from actors.task import make_task_env
from broker_config.errors import StorageError
from broker_config.messages import DemonstrationsBegun, Demonstrator, Trajectory, TrajectoryId
from broker_config.preset import Preset, preset_from_json
from broker_config.structure import to_plain
from broker_config.version import VERSION
from deploy.demonstrations.demonstrators import ActingDemonstrator
from deploy.demonstrations.folder import DemonstrationFolder
from deploy.evaluation.played_episodes import sound_episode
from discriminator.targets import target_states
from learner.recorded import Demonstrations
from learner.tickets import make_ticket

ACTOR: Final = "demonstrator"
LEAST_TARGETS: Final = 3
"""Demonstrations to imitate with fewer are drawn anew, by this rule and never by their returns."""
MOST_DRAWS: Final = 20
_SEEDS_OF_A_DRAW = 1_000_003


def preset_of_draw(preset: Preset, draw: int) -> Preset:
    """The preset with the seed of a draw; draw 0 has its own."""
    return replace(preset, seed=(preset.seed + draw * _SEEDS_OF_A_DRAW) % 2**32)


def make_demonstrations(
    preset: Preset,
    path: Path,
    episodes: int,
    demonstrator: ActingDemonstrator,
    least_targets: int = 0,
    on_episode: Callable[[Trajectory, int], None] = lambda _, __: None,
) -> Demonstrations:
    """Plays into a folder what it does not hold yet of so many episodes.

    Args:
        preset: Whose task is played.
        path: The folder; one of the same demonstrator, task and seed is gone on with.
        episodes: How many there shall be.
        demonstrator: Who acts.
        least_targets: Where so many episodes hold fewer target states, all are drawn anew from
            other seeds; what a person has marked is never drawn anew.
        on_episode: Told of each new episode once it is on the disk, and of its draw.

    Returns:
        All that the folder holds, which may be more than was asked for.

    Raises:
        AlreadyOwned: Another process makes them.
        PresetError: The task has no script.
        StorageError: The folder holds something else, also what another demonstrator made, or no
            draw has enough targets.
    """
    with DemonstrationFolder(path) as folder:
        _refuse_others(folder, preset, demonstrator.who)
        origin = folder.made.origin
        first_draw = origin.draw if isinstance(origin, DemonstrationsBegun) else 0
        for draw in range(first_draw, MOST_DRAWS):
            drawn = preset_of_draw(preset, draw)
            if draw > first_draw or origin is None:
                who = demonstrator.who
                folder.begin(DemonstrationsBegun(who, draw, drawn.to_json(), VERSION))
            if len(folder.made.trajectories) < episodes:
                for trajectory in _play(folder, drawn, episodes, demonstrator):
                    on_episode(trajectory, draw)
            if folder.made.marks is not None or _n_targets(folder.made, preset) >= least_targets:
                return folder.made
    raise StorageError(
        f"{path}: expected at least {least_targets} target states among {episodes} demonstrations "
        f"in one of {MOST_DRAWS} draws; got fewer; make fewer mistakes, or demonstrate more"
    )


def _play(
    folder: DemonstrationFolder,
    preset: Preset,
    episodes: int,
    demonstrator: ActingDemonstrator,
) -> Iterator[Trajectory]:
    """Adds what is missing; yields each episode once it is on the disk."""
    life = _life(preset, demonstrator.who)
    with closing(make_task_env(preset.task)) as env:
        policy = demonstrator.acting_in(env)
        for index in range(len(folder.made.trajectories), episodes):
            id_ = TrajectoryId(ACTOR, life, index)
            trajectory, seen_unix_secs = _played(env, policy, preset, demonstrator, id_)
            folder.add(trajectory, seen_unix_secs)
            yield trajectory


def _played(
    env: ClothbusEnv,
    policy: ActingPolicy,
    preset: Preset,
    demonstrator: ActingDemonstrator,
    id_: TrajectoryId,
) -> tuple[Trajectory, list[float]]:
    """An episode, and when each of its observations was made."""
    seen_unix_secs: list[float] = []

    def play(generation: int) -> Trajectory:
        ticket = replace(
            make_ticket(preset, id_.sequence, attempt=generation, generation=generation),
            policy_version=demonstrator.policy_version,
            epsilon=demonstrator.epsilon,
        )
        seen_unix_secs[:] = [time.time()]
        return collect(env, policy, ticket, id_, lambda: seen_unix_secs.append(time.time()))

    return sound_episode(id_.sequence, play), seen_unix_secs


def _life(preset: Preset, who: Demonstrator) -> str:
    """Names what determines every episode: made again elsewhere, demonstrations have the same ids.

    A run that is resumed takes them for those that it began with.
    """
    demonstrator = {name: to_plain(value) for name, value in vars(who).items() if name != "dataset"}
    determining = json.dumps(
        [demonstrator, to_plain(preset.task), preset.seed], sort_keys=True, separators=(",", ":")
    )
    return hashlib.sha256(determining.encode()).hexdigest()[:16]


def _refuse_others(folder: DemonstrationFolder, preset: Preset, who: Demonstrator) -> None:
    origin = folder.made.origin
    if not isinstance(origin, DemonstrationsBegun):
        return
    kept = preset_from_json(origin.preset_json)
    wanted = preset_of_draw(preset, origin.draw)
    differing = [
        name
        for name, mine, theirs in (
            ("demonstrator", who, origin.demonstrator),
            ("task", wanted.task, kept.task),
            ("seed", wanted.seed, kept.seed),
        )
        if mine != theirs
    ]
    if differing:
        raise StorageError(
            f"{folder.path}: expected demonstrations of {preset.name} by {who}; got those of "
            f"{kept.name} by {origin.demonstrator} (another {', '.join(differing)}); make them in "
            "another folder"
        )


def _n_targets(made: Demonstrations, preset: Preset) -> int:
    target_reward = preset.imitation.target_reward if preset.imitation else None
    return sum(int(each.sum()) for each in target_states(made.trajectories, target_reward))
