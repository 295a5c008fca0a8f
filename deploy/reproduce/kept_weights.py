"""Reads what runs have left in their work folder: policies and discriminators."""

from __future__ import annotations

from pathlib import Path

from actors.policy import Policy
from broker_config.errors import StorageError
from deploy.reproduce.runs import CLONED, RunPlan
from deploy.reproduce.work_folder import discriminators_file, policy_file
from learner.cloning import cloning_preset


def kept_policy(work: Path, plan: RunPlan) -> Policy:
    """A run's last policy.

    Raises:
        StorageError: It is not there.
    """
    preset = cloning_preset(plan.preset) if plan.key.start in CLONED else plan.preset
    weights = _read(policy_file(work, plan), f"the last policy of {plan.key.name}")
    return Policy.from_bytes(preset.network, weights)


def kept_discriminators(work: Path, plan: RunPlan, iteration: int) -> bytes:
    """The weights of a run's discriminators, as `StoredDiscriminators` takes them.

    Raises:
        StorageError: They are not there.
    """
    what = f"the discriminators of {plan.key.name} in iteration {iteration}"
    return _read(discriminators_file(work, plan, iteration), what)


def _read(path: Path, what: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise StorageError(
            f"{path}: expected {what}; got {error}; run its experiment with the same --work, and "
            "with another --output than that which holds the curve already: weights stay where "
            "they were made"
        ) from error
