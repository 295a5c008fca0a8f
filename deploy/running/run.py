"""`clothbus run`: a whole run on this machine, over the bus.

Nothing here learns or acts, so neither torch nor a simulator is imported.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from broker_config.bus import Bus, open_bus
from broker_config.errors import OwnerUnreachable, RouterUnreachable
from broker_config.heart import HUNG_SECS
from broker_config.keys import Kind
from broker_config.messages import Command, Control, ControlReply, Heartbeat, Metrics
from broker_config.ownership import FileLock
from broker_config.preset import Preset
from deploy.evaluation.farewell import EvaluatorFarewell
from deploy.priority import Priority
from deploy.process import interrupt, on_terminate, take_when_free
from deploy.recorder.farewell import RecorderFarewell
from deploy.run_folder import RunFolder
from deploy.running.launch import ProcessFailed, Supervisor
from deploy.running.leftovers import deliver_spools, lacks_recording
from deploy.running.progress import Progress
from deploy.running.summary import is_complete, summarise
from deploy.running.topology import (
    DISCRIMINATOR,
    EVALUATOR,
    RECORDER,
    actor_process,
    discriminator_process,
    evaluator_process,
    learner_process,
    recorder_process,
    router_process,
)
from deploy.running.vital_signs import VitalSigns
from learner.steps.compute import ON_CPU, Compute

ROUTER_START_SECS = 30.0
LEAVE_SECS = 10.0
"""How long actors have to leave once the learner, which has told them so, has finished."""

POLL_SECS = 0.1
ASK_SECS = 2.0


@dataclass(frozen=True)
class RunOptions:
    """How a run is carried out; nothing here changes what is learned."""

    actors: int
    compute: Compute = ON_CPU
    address: str | None = None
    """Of a router that runs already; None starts one."""
    demonstrations: Path | None = None
    step_log: Path | None = None
    evaluate: int = 0
    """Episodes for each policy that an evaluator scores meanwhile; 0 for no evaluator."""
    evaluator_priority: Priority = "idle"
    hung_secs: float = HUNG_SECS
    """A process that gets nowhere for so long is killed and started again."""
    overrides: tuple[str, ...] = ()
    record: bool = True
    """Into the run folder; a run in one process has no recorder."""


def run_over_bus(folder: RunFolder, preset: Preset, options: RunOptions, console: Console) -> bool:
    """Starts router, learner and actors, shows progress, and ends them.

    A run that is complete already is only given what it still owes.

    Returns:
        Whether the run is complete; False after Ctrl-C or `clothbus control stop`.

    Raises:
        ProcessFailed: A process cannot be kept alive.
    """

    def carry_out(progress: Progress) -> None:
        if not is_complete(folder):
            _supervise(folder, preset, options, progress)
            return
        deliver_spools(folder, preset)
        if options.record and lacks_recording(folder):
            _supervise(folder, preset, replace(options, actors=0, evaluate=0), progress)

    return conduct(folder, preset, options.compute, console, carry_out)


def conduct(
    folder: RunFolder,
    preset: Preset,
    compute: Compute,
    console: Console,
    carry_out: Callable[[Progress], None],
) -> bool:
    """Carries out a run with progress, until it ends or is stopped, and says how it went.

    Returns:
        Whether the run is complete.
    """
    began_secs = time.monotonic()
    console.print(f"Run folder: {folder.path}", highlight=False, soft_wrap=True)
    console.print(f"Training: {compute}", highlight=False)
    on_terminate(interrupt)
    with take_when_free(lambda: FileLock(folder.path / "run.lock", f"run {folder.path}")):
        with Progress(preset, console) as progress, suppress(KeyboardInterrupt):
            carry_out(progress)
        summary = summarise(folder, time.monotonic() - began_secs)
    console.print(summary.text, highlight=False, soft_wrap=True)
    return summary.is_complete


def _supervise(folder: RunFolder, preset: Preset, options: RunOptions, progress: Progress) -> None:
    is_resumed = folder.journal.exists()
    signs = VitalSigns(options.hung_secs)
    with Supervisor(folder.path / "logs", signs) as supervisor:
        address = options.address or _start_router(supervisor, folder, options)
        _start_learner(supervisor, folder, address, options)
        with ExitStack() as stack:
            bus = _attach(stack, supervisor, address, folder.run, options)
            bus.subscribe(bus.keys.every(Kind.LIVE), Heartbeat, signs.on_heartbeat)
            evaluator = EvaluatorFarewell(bus, EVALUATOR) if options.evaluate else None
            recorder = RecorderFarewell(bus, RECORDER) if options.record else None
            if is_resumed:
                _unpause(supervisor, bus)
            workers = _start_actors(supervisor, folder, address, options)
            if preset.has_discriminators and options.actors:
                supervisor.start(discriminator_process(folder.run, address, options.overrides))
                workers.append(DISCRIMINATOR)
            _watch(supervisor, bus, progress)
            supervisor.release(workers)
            if evaluator is not None:
                evaluator.wait(supervisor, progress)
            if recorder is not None:
                recorder.wait(supervisor)
        supervisor.wait_ended(workers, LEAVE_SECS)


def _start_learner(
    supervisor: Supervisor, folder: RunFolder, address: str, options: RunOptions
) -> None:
    """Starts the learner and the recorder that follows it."""
    supervisor.start(
        learner_process(
            folder.path,
            address,
            options.compute,
            options.demonstrations,
            options.hung_secs,
            options.overrides,
        )
    )
    if options.record:
        supervisor.start(recorder_process(folder.run, folder.recording, address, options.overrides))


def _start_actors(
    supervisor: Supervisor, folder: RunFolder, address: str, options: RunOptions
) -> list[str]:
    """Starts those who play, the evaluator among them; returns the actors' names."""
    actors = [f"actor-{number}" for number in range(options.actors)]
    for actor in actors:
        spool, step_log = folder.spool(actor), options.step_log
        supervisor.start(
            actor_process(folder.run, actor, spool, address, step_log, options.overrides)
        )
    if options.evaluate:
        supervisor.start(
            evaluator_process(
                folder.run,
                folder.path,
                options.evaluate,
                address,
                options.evaluator_priority,
                options.overrides,
            )
        )
    return actors


def _attach(
    stack: ExitStack, supervisor: Supervisor, address: str, run: str, options: RunOptions
) -> Bus:
    """Opens the supervisor's own bus, also when the router dies at just that moment."""
    deadline_secs = time.monotonic() + ROUTER_START_SECS
    while True:
        try:
            return stack.enter_context(open_bus(address, run, "observer", "run", options.overrides))
        except RouterUnreachable:
            supervisor.check()
            if options.address or time.monotonic() > deadline_secs:
                raise


def _watch(supervisor: Supervisor, bus: Bus, progress: Progress) -> None:
    """Shows progress and keeps the processes alive until the learner has finished."""
    bus.subscribe(bus.keys.metrics("owner", "learner"), Metrics, progress.on_metrics)
    while not supervisor.has_finished("learner"):
        supervisor.check()
        progress.show(supervisor.processes)
        time.sleep(POLL_SECS)
    progress.show(supervisor.processes)


def _unpause(supervisor: Supervisor, bus: Bus) -> None:
    """A run that a person starts again shall go on, also if it was paused when it was left.

    It is done before there are actors: one that was drained then would leave again.
    """
    while not supervisor.has_finished("learner"):
        supervisor.check()
        try:
            bus.ask(bus.keys.control, Control(Command.RESUME), ControlReply, timeout_secs=ASK_SECS)
        except OwnerUnreachable:
            time.sleep(POLL_SECS)
        else:
            return


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
