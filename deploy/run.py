"""`clothbus run`: a whole run on this machine, over the bus or in one process."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from actors.step_log import StepLog
from actors.task import make_task_env
from broker_config.bus import Bus, open_bus
from broker_config.errors import OwnerUnreachable
from broker_config.journal import Journal
from broker_config.messages import Command, Control, ControlReply, Metrics
from broker_config.ownership import FileLock, own_run
from broker_config.preset import Preset
from deploy.in_process import ACTOR, InProcessActor
from deploy.launch import ProcessFailed, Supervisor
from deploy.process import interrupt, on_terminate, use_one_torch_thread
from deploy.progress import Progress
from deploy.run_folder import RunFolder
from deploy.summary import summarise
from deploy.topology import actor_process, learner_process, router_process
from learner.checkpoint import CheckpointStore
from learner.learning import LearningLoop
from learner.metrics import LearningMetrics
from learner.owner import Owner
from learner.recorded import read_demonstrations
from learner.snapshots import SnapshotStore
from learner.trainer import Trainer

ROUTER_START_SECS = 30.0
LEAVE_SECS = 30.0
"""How long actors have to leave once the learner has finished."""

POLL_SECS = 0.1


@dataclass(frozen=True)
class RunOptions:
    """How a run is carried out; nothing here changes what is learned."""

    actors: int
    device: str = "cpu"
    address: str | None = None
    """Of a router that runs already; None starts one."""
    demonstrations: Path | None = None
    step_log: Path | None = None
    overrides: tuple[str, ...] = ()


def run_over_bus(folder: RunFolder, preset: Preset, options: RunOptions, console: Console) -> bool:
    """Starts router, learner and actors, shows progress, and ends them.

    Returns:
        Whether the run is complete; False after Ctrl-C or `clothbus control stop`.

    Raises:
        ProcessFailed: A process cannot be kept alive.
    """
    return _run(folder, preset, console, lambda show: _supervise(folder, options, show))


def run_in_process(
    folder: RunFolder, preset: Preset, options: RunOptions, console: Console
) -> bool:
    """The same run in this process, without a bus.

    Returns:
        Whether the run is complete; False after Ctrl-C.
    """
    return _run(folder, preset, console, lambda show: _play_here(folder, preset, options, show))


def _run(
    folder: RunFolder, preset: Preset, console: Console, carry_out: Callable[[Progress], None]
) -> bool:
    began_secs = time.monotonic()
    console.print(f"Run folder: {folder.path}", highlight=False, soft_wrap=True)
    on_terminate(interrupt)
    with FileLock(folder.path / "run.lock", f"run {folder.path}"):
        with Progress(preset, console) as progress, suppress(KeyboardInterrupt):
            carry_out(progress)
        summary = summarise(folder, time.monotonic() - began_secs)
    console.print(summary.text, highlight=False, soft_wrap=True)
    return summary.is_complete


def _supervise(folder: RunFolder, options: RunOptions, progress: Progress) -> None:
    with Supervisor(folder.path / "logs") as supervisor:
        address = options.address or _start_router(supervisor, folder, options)
        learner = learner_process(
            folder.path, address, options.device, options.demonstrations, options.overrides
        )
        supervisor.start(learner)
        actors = [f"actor-{number}" for number in range(options.actors)]
        for actor in actors:
            spool = folder.spool(actor)
            supervisor.start(
                actor_process(
                    folder.run, actor, spool, address, options.step_log, options.overrides
                )
            )
        with open_bus(address, folder.run, "observer", "run", options.overrides) as bus:
            _watch(supervisor, bus, progress)
        supervisor.wait_finished(actors, LEAVE_SECS)


def _watch(supervisor: Supervisor, bus: Bus, progress: Progress) -> None:
    """Shows progress and keeps the processes alive until the learner has finished."""
    bus.subscribe(bus.keys.metrics("owner", "learner"), Metrics, progress.on_metrics)
    is_unpaused = False
    while not supervisor.has_finished("learner"):
        supervisor.check()
        progress.show(supervisor.processes)
        is_unpaused = is_unpaused or _unpause(bus)
        time.sleep(POLL_SECS)
    progress.show(supervisor.processes)


def _unpause(bus: Bus) -> bool:
    """A run that a person starts again shall go on, also if it was paused when it was left."""
    try:
        bus.ask(bus.keys.control, Control(Command.RESUME), ControlReply, timeout_secs=POLL_SECS)
    except OwnerUnreachable:
        return False
    return True


def _start_router(supervisor: Supervisor, folder: RunFolder, options: RunOptions) -> str:
    """Starts the embedded router and waits until it says where it listens."""
    address_file = folder.router_address
    address_file.unlink(missing_ok=True)  # of an earlier part of the run: its port may be taken
    supervisor.start(router_process(address_file, options.overrides))
    deadline_secs = time.monotonic() + ROUTER_START_SECS
    while time.monotonic() < deadline_secs:
        supervisor.check()
        if address_file.exists():
            return address_file.read_text().strip()
        time.sleep(POLL_SECS)
    raise ProcessFailed(
        f"router: expected an address within {ROUTER_START_SECS:g} s; got none; "
        f"see {folder.log('router')}"
    )


def _play_here(folder: RunFolder, preset: Preset, options: RunOptions, progress: Progress) -> None:
    use_one_torch_thread()
    task = make_task_env(preset.task)
    with (
        own_run(folder.path),
        Journal(folder.journal) as journal,
        LearningMetrics(folder.tensorboard) as metrics,
        closing(StepLog(task, options.step_log, ACTOR) if options.step_log else task) as env,
    ):
        owner = Owner(folder.run, preset, journal)
        owner.control(Control(Command.RESUME))
        snapshots = SnapshotStore(folder.snapshots)
        loop = LearningLoop(
            owner,
            Trainer(preset, options.device),
            CheckpointStore(folder.checkpoints),
            snapshots,
            read_demonstrations(options.demonstrations) if options.demonstrations else (),
            InProcessActor(owner, env, snapshots).play_until_ready,
        )
        for event in loop:
            metrics.note(event)
            progress.update(metrics.numbers)
            progress.show()
