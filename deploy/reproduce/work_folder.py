"""Where runs leave what is too large for the repository: checkpoints and weights."""

from __future__ import annotations

import hashlib
from pathlib import Path

from deploy.reproduce.runs import RunKey, RunPlan


def checkpoints_folder(work: Path, key: RunKey) -> Path:
    """Where an unfinished run keeps what it goes on from."""
    return work / "checkpoints" / key.name


def policy_file(work: Path, plan: RunPlan) -> Path:
    """Where a run's last policy is kept."""
    return work / "policies" / f"{plan.key.name}.safetensors"


def policy_digest(path: Path) -> str | None:
    """SHA-256 of a policy's file; None where there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else None


def discriminators_file(work: Path, plan: RunPlan, iteration: int) -> Path:
    """Where the discriminators are kept that labelled an iteration's samples last."""
    return work / "discriminators" / plan.key.name / f"{iteration}.safetensors"
