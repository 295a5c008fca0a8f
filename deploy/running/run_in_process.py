"""`clothbus run --in-process`: a whole run in this process, without a bus."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing

from rich.console import Console

from actors.step_log import StepLog
from actors.task import make_task_env
from broker_config.journal import Journal
from broker_config.messages import Command, Control
from broker_config.ownership import own_run
from broker_config.preset import Preset
from deploy.process import take_when_free, use_one_torch_thread
from deploy.run_folder import RunFolder
from deploy.running.in_process import (
    ACTOR,
    AnsweringActor,
    InProcessActor,
    InProcessDiscriminators,
)
from deploy.running.leftovers import deliver_spools
from deploy.running.progress import Progress
from deploy.running.run import RunOptions, conduct
from deploy.running.summary import is_complete
from learner.checkpoint import CheckpointStore
from learner.learning import LearningLoop
from learner.metrics import LearningMetrics
from learner.owner import Owner
from learner.recorded import Demonstrations, read_demonstrations
from learner.snapshots import SnapshotStore
from learner.steps.compute import Compute
from learner.trainer import Trainer


def run_in_process(
    folder: RunFolder, preset: Preset, options: RunOptions, console: Console
) -> bool:
    """Carries out a run in this process, with the cores that a run over the bus has.

    Returns:
        Whether the run is complete; False after Ctrl-C.
    """

    def carry_out(progress: Progress) -> None:
        if is_complete(folder):
            deliver_spools(folder, preset)
        else:
            _play(folder, preset, options, progress)

    return conduct(folder, preset, options.compute, console, carry_out)


def _play(folder: RunFolder, preset: Preset, options: RunOptions, progress: Progress) -> None:
    task = make_task_env(preset.task)
    with closing(StepLog(task, options.step_log, ACTOR) if options.step_log else task) as env:

        def make_actor(owner: Owner, snapshots: SnapshotStore) -> AnsweringActor:
            return InProcessActor(owner, env, snapshots)

        given = options.demonstrations
        demonstrations = read_demonstrations(given) if given else None
        learn_in_process(folder, preset, options.compute, demonstrations, make_actor, progress)


def learn_in_process(
    folder: RunFolder,
    preset: Preset,
    compute: Compute,
    demonstrations: Demonstrations | None,
    make_actor: Callable[[Owner, SnapshotStore], AnsweringActor],
    progress: Progress,
) -> None:
    """Learns in this process until the run is complete, or goes on with it.

    Args:
        folder: Of the run.
        preset: Of the run.
        compute: What the learner computes on.
        demonstrations: For Algorithm 2 or for discriminators.
        make_actor: Makes whoever answers the tickets.
        progress: Told of all that happens.
    """
    use_one_torch_thread()
    with (
        take_when_free(lambda: own_run(folder.path)),
        Journal(folder.journal) as journal,
        LearningMetrics(folder.tensorboard) as metrics,
    ):
        owner = Owner(folder.run, preset, journal)
        owner.control(Control(Command.RESUME))
        snapshots = SnapshotStore(folder.snapshots)
        discriminators = (
            InProcessDiscriminators(owner, journal) if preset.has_discriminators else None
        )
        loop = LearningLoop(
            owner,
            Trainer(preset, compute),
            CheckpointStore(folder.checkpoints),
            snapshots,
            demonstrations,
            make_actor(owner, snapshots).play_until_ready,
            discriminators.wait_rewards if discriminators else None,
        )
        for event in loop:
            metrics.note(event)
            progress.update(metrics.numbers)
            progress.show()
