"""The demonstrations of an experiment's runs: the same for all conditions of a seed."""

from __future__ import annotations

import fcntl
from dataclasses import replace
from pathlib import Path

from broker_config.errors import StorageError
from broker_config.messages import Trajectory
from broker_config.preset import ImitationPreset, Preset
from deploy.demonstrations.demonstrators import (
    ActingDemonstrator,
    by_script,
    by_version,
)
from deploy.demonstrations.making import (
    LEAST_TARGETS,
    MOST_DRAWS,
    make_demonstrations,
    preset_of_draw,
)
from deploy.reproduce.kept_weights import kept_policy
from deploy.reproduce.runs import RunPlan
from deploy.reproduce.work_folder import policy_digest, policy_file
from discriminator.targets import target_states
from learner.cloning import cloning_preset
from learner.recorded import Demonstrations, first_samples


def demonstrations_of(plan: RunPlan, work: Path) -> list[Trajectory]:
    """As many samples as the run asks for, or none; whoever needs them first makes them.

    Args:
        plan: Of the run.
        work: Folder in which they are kept.

    Raises:
        StorageError: The demonstrator is so bad that no draw has enough targets, or it is a run
            that has left no policy here.
    """
    preset, rate = plan.preset, plan.key.mistake_rate
    wanted = preset.initialisation or preset.imitation
    if wanted is None or (rate is None and plan.demonstrator is None):
        return []
    for draw in range(MOST_DRAWS):
        played = _played(plan, work, wanted.demonstration_samples, draw)
        given = list(first_samples(played, wanted.demonstration_samples).trajectories)
        if preset.imitation is None or _has_targets(given, preset.imitation):
            return given
    raise StorageError(
        f"{plan.key.name}: expected at least {LEAST_TARGETS} target states among its "
        f"demonstrations in one of {MOST_DRAWS} draws; got fewer; make fewer mistakes, or "
        "demonstrate more"
    )


def _played(plan: RunPlan, work: Path, samples: int, draw: int) -> Demonstrations:
    """At least so many samples of the demonstrator; each draw has seeds of its own."""
    # Whatever learns from them has nothing to do with how they are made.
    drawn = preset_of_draw(cloning_preset(plan.preset), draw)
    neutral = replace(
        drawn,
        algorithm=replace(drawn.algorithm, ends_at_horizon=False),
        exploration=None,
        initialisation=None,
        imitation=None,
        augmentation=None,
    )
    name, demonstrator = _demonstrator(plan, neutral, work)
    folder = work / "demonstrations" / f"{neutral.digest[:12]}-{name}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    episodes = -(-samples // plan.preset.task.horizon)
    with folder.with_name(f"{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return make_demonstrations(neutral, folder, episodes, demonstrator)


def _demonstrator(plan: RunPlan, neutral: Preset, work: Path) -> tuple[str, ActingDemonstrator]:
    """Who demonstrates to a run, and a name for what it demonstrates."""
    if plan.demonstrator is None:
        rate = plan.key.mistake_rate
        assert rate is not None  # or nothing is demonstrated
        return f"scripted-{rate:g}", by_script(neutral, rate)
    learned, name = plan.demonstrator, plan.demonstrator.key.name
    policy = kept_policy(work, learned)
    version = learned.preset.schedule.iteration_versions()[-1]
    digest = policy_digest(policy_file(work, learned))
    assert digest is not None  # it has just been read
    return name, by_version(name, learned.preset, version, digest, policy)


def _has_targets(demonstrations: list[Trajectory], imitation: ImitationPreset) -> bool:
    """Whether they show enough for D_T; asked alike whichever discriminators take part."""
    targets = target_states(demonstrations, imitation.target_reward)
    return sum(int(each.sum()) for each in targets) >= LEAST_TARGETS
