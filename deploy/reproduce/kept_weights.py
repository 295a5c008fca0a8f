"""What runs leave in their work folder: last policies, and the discriminators of each iteration."""

from __future__ import annotations

from pathlib import Path

from actors.policy import Policy
from broker_config.errors import StorageError
from deploy.reproduce.runs import CLONED, RunPlan
from learner.cloning import cloning_preset


def policy_file(work: Path, plan: RunPlan) -> Path:
    """Where a run's last policy is kept."""
    return work / "policies" / f"{plan.key.name}.safetensors"


def discriminators_file(work: Path, plan: RunPlan, iteration: int) -> Path:
    """Where the discriminators are kept that labelled an iteration's samples last."""
    return work / "discriminators" / plan.key.name / f"{iteration}.safetensors"


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
            f"{path}: expected {what}; got {error}; run its experiment first, with the same --work"
        ) from error
