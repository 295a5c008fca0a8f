"""The demonstrations of an experiment's runs: the same for all conditions of a seed."""

from __future__ import annotations

import fcntl
from dataclasses import replace
from pathlib import Path

from broker_config.errors import StorageError
from broker_config.messages import Trajectory
from broker_config.preset import ImitationPreset
from deploy.demonstrations.demonstrators import by_script
from deploy.demonstrations.making import (
    LEAST_TARGETS,
    MOST_DRAWS,
    make_demonstrations,
    preset_of_draw,
)
from deploy.reproduce.runs import RunPlan
from discriminator.targets import target_states
from learner.cloning import cloning_preset
from learner.recorded import Demonstrations, first_samples


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
        given = list(first_samples(played, wanted.demonstration_samples).trajectories)
        if preset.imitation is None or _has_targets(given, preset.imitation):
            return given
    raise StorageError(
        f"{plan.key.name}: expected at least {LEAST_TARGETS} target states among its "
        f"demonstrations in one of {MOST_DRAWS} draws; got fewer; make fewer mistakes, or "
        "demonstrate more"
    )


def _played(plan: RunPlan, work: Path, samples: int, rate: float, draw: int) -> Demonstrations:
    """At least so many samples of the demonstrator; each draw has seeds of its own."""
    # Whatever learns from them has nothing to do with how they are made.
    neutral = replace(
        preset_of_draw(cloning_preset(plan.preset), draw),
        exploration=None,
        initialisation=None,
        imitation=None,
    )
    folder = work / "demonstrations" / f"{neutral.digest[:12]}-scripted-{rate:g}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    episodes = -(-samples // plan.preset.task.horizon)
    with folder.with_name(f"{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return make_demonstrations(neutral, folder, episodes, by_script(neutral, rate))


def _has_targets(demonstrations: list[Trajectory], imitation: ImitationPreset) -> bool:
    """Whether they show enough for D_T; asked alike whichever discriminators take part."""
    targets = target_states(demonstrations, imitation.target_reward)
    return sum(int(each.sum()) for each in targets) >= LEAST_TARGETS
