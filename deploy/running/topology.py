"""Which processes make up a run: data, apart from how they are started."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from broker_config.heart import HUNG_SECS
from broker_config.messages import Role
from deploy.priority import Priority
from learner.steps.compute import ON_CPU, Compute

RECORDER = "recorder"
"""Under which name a run's own recorder is there."""

DISCRIMINATOR = "discriminator"
"""Under which name the discriminators of a run are there."""

EVALUATOR = "evaluator"
"""Under which name a run's own evaluator is there."""


@dataclass(frozen=True)
class ProcessSpec:
    """One process of a run."""

    role: Role
    id: str
    arguments: tuple[str, ...]
    """After `python -m deploy.cli`."""

    @property
    def command(self) -> list[str]:
        """The whole command line."""
        return [sys.executable, "-m", "deploy.cli", *self.arguments]


def router_process(address_file: Path, overrides: tuple[str, ...] = ()) -> ProcessSpec:
    """The embedded router; it chooses a free port and writes its address into the file."""
    arguments = ("router", "--address-file", str(address_file), *_zenoh(overrides))
    return ProcessSpec("router", "router", arguments)


def learner_process(
    folder: Path,
    address: str,
    compute: Compute = ON_CPU,
    demonstrations: Path | None = None,
    hung_secs: float = HUNG_SECS,
    overrides: tuple[str, ...] = (),
) -> ProcessSpec:
    """The learner of a run folder."""
    given = ("--demonstrations", str(demonstrations)) if demonstrations else ()
    arguments = ("learner", str(folder), "--connect", address, "--device", compute.device, *given)
    arguments += ("--training-path", compute.path) if compute.path else ()
    arguments += ("--hung-secs", str(hung_secs))
    return ProcessSpec("owner", "learner", (*arguments, *_zenoh(overrides)))


def actor_process(
    run: str,
    actor: str,
    spool: Path,
    address: str,
    step_log: Path | None = None,
    overrides: tuple[str, ...] = (),
) -> ProcessSpec:
    """An actor that takes the preset of the run."""
    arguments = ("actor", "--run", run, "--id", actor, "--connect", address, "--spool", str(spool))
    logged = ("--step-log", str(step_log)) if step_log else ()
    return ProcessSpec("actor", actor, (*arguments, *logged, *_zenoh(overrides)))


def discriminator_process(run: str, address: str, overrides: tuple[str, ...] = ()) -> ProcessSpec:
    """The discriminators of a run that imitates."""
    arguments = ("discriminator", "--run", run, "--connect", address)
    return ProcessSpec("discriminator", DISCRIMINATOR, (*arguments, *_zenoh(overrides)))


def recorder_process(
    run: str, folder: Path, address: str, overrides: tuple[str, ...] = ()
) -> ProcessSpec:
    """The recorder of a run."""
    arguments = ("record", "--run", run, "--output", str(folder), "--connect", address)
    return ProcessSpec("recorder", RECORDER, (*arguments, *_zenoh(overrides)))


def evaluator_process(
    run: str,
    folder: Path,
    episodes: int,
    address: str,
    priority: Priority = "idle",
    overrides: tuple[str, ...] = (),
) -> ProcessSpec:
    """The evaluator of a run, which writes into the run's folder."""
    where = ("--run", run, "--output", str(folder), "--connect", address)
    arguments = (
        "evaluator",
        "--id",
        EVALUATOR,
        *where,
        "--episodes",
        str(episodes),
        "--priority",
        priority,
    )
    return ProcessSpec("evaluator", EVALUATOR, (*arguments, *_zenoh(overrides)))


def _zenoh(overrides: tuple[str, ...]) -> tuple[str, ...]:
    return ("--zenoh", *overrides) if overrides else ()
