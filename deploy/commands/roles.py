"""Commands that are one process of a run each, on this or another machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from broker_config.heart import HUNG_SECS
from broker_config.session import DEFAULT_ADDRESS
from deploy.commands.option_rules import (
    Settings,
    refuse_unknown_task,
    require_patience,
    require_positive,
)
from deploy.priority import Priority
from deploy.run_folder import router_address
from learner.steps.compute import Compute, TrainingPath


def router(
    listen: str | None = None, address_file: Path | None = None, zenoh: tuple[str, ...] = ()
) -> None:
    """Route the bus.

    Args:
        listen: Address to listen at; tcp/127.0.0.1:7447 unless an address file is given.
        address_file: Choose a free port, and write the address into this file.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.running.roles import run_router

    if listen is None and address_file is None:
        listen = DEFAULT_ADDRESS
    run_router(listen, address_file, zenoh)


def learner(
    folder: Annotated[Path, tyro.conf.Positional],
    /,
    preset: str | None = None,
    settings: Settings = (),
    connect: str = DEFAULT_ADDRESS,
    device: str = "cpu",
    training_path: TrainingPath | None = None,
    demonstrations: Path | None = None,
    hung_secs: float = HUNG_SECS,
    zenoh: tuple[str, ...] = (),
) -> None:
    """Learn, and own the run's journal; an existing run folder is resumed.

    Args:
        folder: The run folder.
        preset: For a new folder: a preset's name or TOML file.
        settings: Settings that replace the preset's.
        connect: Address of the router.
        device: Where to compute: cpu, cuda.
        training_path: How gradient steps are made; chosen by the device if not given.
        demonstrations: Folder of `clothbus demos make`, a run folder or a run's recording.
        hung_secs: An actor that gets nowhere for so long loses its ticket to another one.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.presets import load_preset
    from deploy.run_folder import RunFolder, prepare_run_folder, require_acting
    from deploy.running.kept_compute import settle_compute
    from deploy.running.roles import run_learner

    require_patience(hung_secs)
    if preset is None:
        run_folder = RunFolder(folder)
    else:
        chosen = load_preset(preset, settings)
        refuse_unknown_task(chosen)
        run_folder = prepare_run_folder(folder, chosen)
    require_acting(run_folder)
    chosen = run_folder.read_preset()
    compute = settle_compute(run_folder, Compute(device, training_path))
    run_learner(run_folder, chosen, connect, compute, demonstrations, hung_secs, zenoh)


def actor(
    id: str = "actor-0",  # noqa: A002 - the option's name
    connect: str = DEFAULT_ADDRESS,
    run: str | None = None,
    spool: Path | None = None,
    preset: str | None = None,
    settings: Settings = (),
    spool_steps: bool = False,
    step_log: Path | None = None,
    zenoh: tuple[str, ...] = (),
) -> None:
    """Act for a run, on this or another machine.

    Args:
        id: This actor's name; every actor has its own.
        connect: Address of the router.
        run: The run's name; not needed when the router carries one run.
        spool: File in which trajectories wait for their ack; spools/RUN/ID.sqlite if not given.
        preset: What the run must be; without it, the actor takes what the run is.
        settings: Settings that replace the preset's.
        spool_steps: Make each step durable before the next, as a robot must.
        step_log: File for one line per step on the environment's side.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.presets import load_preset
    from deploy.running.roles import run_actor

    run_actor(
        connect,
        id,
        spool,
        run,
        load_preset(preset, settings) if preset else None,
        spool_steps,
        step_log,
        zenoh,
    )


def discriminator(
    id: str = "discriminator",  # noqa: A002 - the option's name
    connect: str = DEFAULT_ADDRESS,
    run: str | None = None,
    zenoh: tuple[str, ...] = (),
) -> None:
    """Give a run that imitates its rewards, on this or another machine.

    Args:
        id: This process's name; a run has one such process.
        connect: Address of the router, or a run folder that `clothbus run` made.
        run: The run's name; not needed when the router carries one run.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.running.roles import run_discriminator

    run_discriminator(router_address(connect), id, run, zenoh)


def record(
    output: Path,
    id: str = "recorder",  # noqa: A002 - the option's name
    connect: str = DEFAULT_ADDRESS,
    run: str | None = None,
    zenoh: tuple[str, ...] = (),
) -> None:
    """Record a run as MCAP: its whole journal and policies, and what is seen of its live traffic.

    Args:
        output: Folder of the recording; one that is there already is gone on with.
        id: This recorder's name; every recorder of a run has its own.
        connect: Address of the router, or a run folder that `clothbus run` made.
        run: The run's name; not needed when the router carries one run.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.running.roles import run_recorder

    run_recorder(router_address(connect), id, output, run, zenoh)


def evaluator(
    output: Path,
    connect: str = DEFAULT_ADDRESS,
    run: str | None = None,
    episodes: int = 20,
    id: str = "evaluator",  # noqa: A002 - the option's name
    priority: Priority = "idle",
    zenoh: tuple[str, ...] = (),
) -> None:
    """Score the policies of a run while it goes on.

    Args:
        output: Where results, policies and TensorBoard logs go: the run's own folder on the
            learner's machine, or any other, which is made like it.
        connect: Address of the router, or a run folder that `clothbus run` made.
        run: The run's name; not needed when the router carries one run.
        episodes: For each policy version and mode.
        id: This evaluator's name.
        priority: `idle` has what processor time is left over; `normal`, a share.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.run_folder import RunFolder
    from deploy.running.roles import run_evaluator

    require_positive("episodes", episodes)
    run_evaluator(router_address(connect), id, RunFolder(output), episodes, run, priority, zenoh)
