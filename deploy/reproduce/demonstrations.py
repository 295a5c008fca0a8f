"""The demonstrations of an experiment's runs: the same for all conditions of a seed."""

from __future__ import annotations

import fcntl
from dataclasses import replace
from pathlib import Path
from typing import Final

from broker_config.errors import StorageError
from broker_config.messages import Trajectory
from broker_config.preset import ImitationPreset
from deploy.collect import collect_demonstrations
from deploy.reproduce.runs import RunPlan
from discriminator.real_states import real_states
from learner.cloning import cloning_preset
from learner.recorded import first_samples

LEAST_TARGETS: Final = 3
"""Demonstrations with fewer are drawn anew, by this rule and never by their returns."""
MOST_DRAWS: Final = 20
_SEEDS_OF_A_DRAW = 1_000_003


def demonstrations_of(plan: RunPlan, work: Path) -> list[Trajectory]:
    """As many samples as the run asks for, or none; whoever needs them first makes them.

    Args:
        plan: Of the run.
        work: Folder in which they are kept.

    Raises:
        StorageError: The demonstrator is so bad that no draw has enough targets.
    """
    preset, rate = plan.preset, plan.key.mistake_rate
    wanted = preset.initialisation or preset.imitation
    if rate is None or wanted is None:
        return []
    for draw in range(MOST_DRAWS):
        played = _played(plan, work, wanted.demonstration_samples, rate, draw)
        given = list(first_samples(played, wanted.demonstration_samples))
        if preset.imitation is None or _has_targets(given, preset.imitation):
            return given
    raise StorageError(
        f"{plan.key.name}: expected at least {LEAST_TARGETS} target states among its "
        f"demonstrations in one of {MOST_DRAWS} draws; got fewer; make fewer mistakes, or "
        "demonstrate more"
    )


def _played(plan: RunPlan, work: Path, samples: int, rate: float, draw: int) -> list[Trajectory]:
    """At least so many samples of the demonstrator; each draw has seeds of its own."""
    # Whatever learns from them has nothing to do with how they are made.
    neutral = replace(
        cloning_preset(plan.preset),
        seed=(plan.preset.seed + draw * _SEEDS_OF_A_DRAW) % 2**32,
        exploration=None,
        initialisation=None,
        imitation=None,
    )
    folder = work / "demonstrations" / f"{neutral.digest[:12]}-{rate:g}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    episodes = -(-samples // plan.preset.task.horizon)
    with folder.with_name(f"{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return list(collect_demonstrations(neutral, folder, episodes, "scripted", rate))


def _has_targets(demonstrations: list[Trajectory], imitation: ImitationPreset) -> bool:
    """Whether they show enough for D_T; asked alike whichever discriminators take part."""
    targets = real_states(demonstrations, imitation.target_reward)["target"]
    return len(targets) >= LEAST_TARGETS
