"""The processes of a run, each from its arguments to its end."""

from __future__ import annotations

import logging
import secrets
import threading
from pathlib import Path

from broker_config.bus import open_bus
from broker_config.heart import HUNG_SECS, Pulse
from broker_config.journal import Journal
from broker_config.messages import IterationAnnounced, Rewards
from broker_config.ownership import own_run
from broker_config.preset import Preset
from broker_config.session import open_router_on_free_port, open_session
from broker_config.spool import Spool
from deploy.commands.status import only_run
from deploy.priority import Priority
from deploy.process import interrupt, on_terminate, take_when_free, use_one_torch_thread
from deploy.run_folder import RunFolder
from learner.steps.compute import ON_CPU, Compute

_log = logging.getLogger(__name__)

SPOOL_MAX_BYTES = 4 << 30


def run_router(
    listen: str | None, address_file: Path | None = None, overrides: tuple[str, ...] = ()
) -> None:
    """Routes until it is told to end.

    Args:
        listen: The address, or None for the address in the file, or else a free port.
        address_file: Where the address is written, and read again after a restart.
        overrides: Zenoh settings.

    Raises:
        AddressInUse: Another process listens there.
        ConfigurationError: An override is wrong.
    """
    stop = threading.Event()
    on_terminate(stop.set)
    if listen is None and address_file is not None and address_file.exists():
        listen = address_file.read_text().strip()
    if listen is not None:
        session = open_session("router", listen, overrides)
    else:
        session, listen = open_router_on_free_port(overrides=overrides)
    with session:
        if address_file is not None:
            partial = address_file.with_suffix(".partial")
            partial.write_text(f"{listen}\n")
            partial.replace(address_file)
        _log.info("Routing at %s", listen)
        stop.wait()
    interrupt()  # a router is never finished: it has only been asked to leave


def run_learner(
    folder: RunFolder,
    preset: Preset,
    address: str,
    compute: Compute = ON_CPU,
    demonstrations: Path | None = None,
    hung_secs: float = HUNG_SECS,
    overrides: tuple[str, ...] = (),
) -> None:
    """Learns until the run is complete; a second start resumes from the newest checkpoint.

    Raises:
        AlreadyOwned: Another learner has the run.
        RouterUnreachable: There is no router at the address.
        StorageError: The folder cannot be used.
    """
    from learner.checkpoint import CheckpointStore
    from learner.learning import WAIT_SECS, LearningLoop
    from learner.metrics import LearningMetrics
    from learner.owner import Owner
    from learner.recorded import read_demonstrations
    from learner.service import LearnerService
    from learner.snapshots import SnapshotStore
    from learner.trainer import Trainer

    on_terminate(interrupt)
    use_one_torch_thread()
    with (
        take_when_free(lambda: own_run(folder.path)),
        Journal(folder.journal) as journal,
        open_bus(address, folder.run, "owner", "learner", overrides) as bus,
        open_bus(address, folder.run, "owner", "learner", overrides, bus.rejected) as bulk_bus,
        LearningMetrics(folder.tensorboard) as metrics,
    ):
        owner = Owner(folder.run, preset, journal)
        snapshots = SnapshotStore(folder.snapshots)
        pulse = Pulse()

        def wait_ready(index: int) -> bool:
            pulse.beat()
            return owner.wait_ready(index, WAIT_SECS)

        def wait_rewards(announced: IterationAnnounced) -> Rewards | None:
            pulse.beat()
            return owner.wait_rewards(announced, WAIT_SECS)

        loop = LearningLoop(
            owner,
            Trainer(preset, compute, pulse.beat),
            CheckpointStore(folder.checkpoints),
            snapshots,
            read_demonstrations(demonstrations) if demonstrations else None,
            wait_ready,
            wait_rewards,
        )
        LearnerService(
            bus, bulk_bus, "learner", owner, loop, journal, snapshots, metrics, pulse, hung_secs
        ).run()


def run_actor(
    address: str,
    actor: str,
    spool_path: Path | None = None,
    run: str | None = None,
    preset: Preset | None = None,
    spool_steps: bool = False,
    step_log: Path | None = None,
    overrides: tuple[str, ...] = (),
) -> None:
    """Acts for a run until it ends.

    Args:
        address: The router's.
        actor: This actor's name.
        spool_path: The file in which its trajectories wait; `spools/<run>/<actor>.sqlite` if None.
        run: The run, or None if the router carries only one.
        preset: What the run must be, or None to take what it is.
        spool_steps: Make each step durable before the next, as a robot must.
        step_log: Where to write one line for each step on the environment's side.
        overrides: Zenoh settings.

    Raises:
        AttachRefused: Versions or presets differ, or the name is taken.
        OwnerUnreachable: The router carries no run, or several and none was named.
        RouterUnreachable: There is no router at the address.
        StorageError: The spool cannot be used.
    """
    from actors.service import Actor
    from actors.step_log import StepLog

    use_one_torch_thread()
    incarnation = secrets.token_hex(8)
    run = run or only_run(address, overrides)
    path = spool_path or Path("spools") / run / f"{actor}.sqlite"
    with (
        take_when_free(lambda: Spool(path, run, actor, incarnation, SPOOL_MAX_BYTES)) as spool,
        open_bus(address, run, "actor", actor, overrides) as bus,
    ):
        process = Actor(
            bus,
            actor,
            spool,
            incarnation,
            preset,
            spool_steps=spool_steps,
            wrap_env=lambda env: StepLog(env, step_log, incarnation) if step_log else env,
        )
        on_terminate(process.stop)
        has_finished = process.run()
    if not has_finished:
        interrupt()


def run_discriminator(
    address: str, discriminator: str, run: str | None = None, overrides: tuple[str, ...] = ()
) -> None:
    """Gives a run that imitates its rewards, until its last iteration has them.

    Args:
        address: The router's.
        discriminator: This process's name.
        run: The run, or None if the router carries only one.
        overrides: Zenoh settings.

    Raises:
        AttachRefused: The owner's versions differ, or the run has a discriminator service.
        OwnerUnreachable: The router carries no run, or several and none was named.
        PresetError: The run does not imitate.
        RouterUnreachable: There is no router at the address.
    """
    from discriminator.service import DiscriminatorService

    use_one_torch_thread()
    run = run or only_run(address, overrides)
    with open_bus(address, run, "discriminator", discriminator, overrides) as bus:
        process = DiscriminatorService(bus, discriminator, secrets.token_hex(8))
        on_terminate(process.stop)
        has_finished = process.run()
    if not has_finished:
        interrupt()


def run_evaluator(
    address: str,
    evaluator: str,
    folder: RunFolder,
    episodes: int,
    run: str | None = None,
    priority: Priority = "idle",
    overrides: tuple[str, ...] = (),
) -> None:
    """Scores the policies of a run while it goes on; leaves when its last one is scored.

    Args:
        address: The router's.
        evaluator: This evaluator's name.
        folder: Where results and policies go: the run's own folder, or another.
        episodes: For each policy version and mode.
        run: The run, or None if the router carries only one.
        priority: Whether it gives way to everybody else on the machine.
        overrides: Zenoh settings.

    Raises:
        AttachRefused: The owner's versions differ.
        OwnerUnreachable: The router carries no run, or several and none was named.
        RouterUnreachable: There is no router at the address.
        StorageError: The folder cannot be used, or is another run's.
    """
    from deploy.evaluation.evaluator import Evaluator

    use_one_torch_thread()
    run = run or only_run(address, overrides)
    with open_bus(address, run, "evaluator", evaluator, overrides) as bus:
        process = Evaluator(bus, evaluator, secrets.token_hex(8), folder, episodes, priority)
        on_terminate(process.stop)
        has_finished = process.run()
    if not has_finished:
        interrupt()


def run_recorder(
    address: str,
    recorder: str,
    folder: Path,
    run: str | None = None,
    overrides: tuple[str, ...] = (),
) -> None:
    """Records a run until it ends.

    Args:
        address: The router's.
        recorder: This recorder's name.
        folder: Of the recording; what is there already is gone on with.
        run: The run, or None if the router carries only one.
        overrides: Zenoh settings.

    Raises:
        AlreadyOwned: Another recorder has the folder or the name.
        AttachRefused: The owner's versions differ.
        OwnerUnreachable: The router carries no run, or several and none was named.
        RouterUnreachable: There is no router at the address.
        StorageError: The folder holds something that must not be touched.
    """
    from broker_config.recording.recording import lock_recording
    from deploy.recorder.recorder import Recorder

    run = run or only_run(address, overrides)
    with (
        take_when_free(lambda: lock_recording(folder)),
        open_bus(address, run, "recorder", recorder, overrides) as bus,
    ):
        process = Recorder(bus, recorder, folder, secrets.token_hex(8))
        on_terminate(process.stop)
        has_finished = process.run()
    if not has_finished:
        interrupt()
