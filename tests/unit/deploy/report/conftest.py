"""A real run that imitates, made in this process, with faults that are known."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import dataclass

import pytest

from actors.task import make_task_env
from broker_config.journal import Journal, JournalReader
from broker_config.messages import (
    Command,
    Control,
    Metrics,
    Presence,
    Snapshot,
    TicketRequest,
    weights_digest,
)
from broker_config.preset import Preset
from broker_config.recording.recording import Recording
from deploy.demonstrations.demonstrators import by_script
from deploy.demonstrations.making import make_demonstrations
from deploy.evaluation.evaluate import evaluate
from deploy.evaluation.scores import Score
from deploy.presets import load_preset
from deploy.report.gather import gather
from deploy.report.record import RunRecord
from deploy.report.sources import open_source
from deploy.run_folder import RunFolder, create_run_folder
from deploy.running.in_process import InProcessActor, InProcessDiscriminators
from learner.checkpoint import CheckpointStore
from learner.learning import EpisodeAbsorbed, LearningLoop, PolicyReady
from learner.owner import Owner
from learner.recorded import Demonstrations
from learner.snapshots import SnapshotStore
from learner.tickets import LEASE_SECS
from learner.trainer import Trainer

ITERATIONS = 2
SHORT = (f"schedule.iterations={ITERATIONS}", "schedule.episodes_per_iteration=2")


@dataclass(frozen=True)
class MadeRun:
    folder: RunFolder
    preset: Preset
    demonstrations: Demonstrations
    scores: list[Score]


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> MadeRun:
    """The learner dies after its first episode, an actor vanishes, the recorder starts again."""
    made = tmp_path_factory.mktemp("report")
    preset = load_preset("imitation-smoke", SHORT)
    demonstrations = make_demonstrations(preset, made / "demos", 3, by_script(preset, 0.0))
    folder = create_run_folder(made, preset)
    learn(folder, preset, demonstrations, dies_after=1)
    learn(folder, preset, demonstrations)
    scores = evaluate(folder, (), episodes=2, mode="greedy", jobs=1)
    record(folder, preset)
    return MadeRun(folder, preset, demonstrations, scores)


@pytest.fixture(scope="session")
def gathered(run: MadeRun) -> RunRecord:
    return gather(open_source(run.folder.path))


def learn(
    folder: RunFolder,
    preset: Preset,
    demonstrations: Demonstrations,
    dies_after: int | None = None,
) -> None:
    with Journal(folder.journal) as journal, closing(make_task_env(preset.task)) as env:
        owner = Owner(folder.run, preset, journal)
        snapshots = SnapshotStore(folder.snapshots)
        loop = LearningLoop(
            owner,
            Trainer(preset),
            CheckpointStore(folder.checkpoints),
            snapshots,
            None if folder.checkpoints.is_dir() and dies_after is None else demonstrations,
            InProcessActor(owner, env, snapshots).play_until_ready,
            InProcessDiscriminators(owner, journal).wait_rewards,
        )
        for event in loop:
            if dies_after and isinstance(event, PolicyReady):
                owner.control(Control(Command.PAUSE))
                owner.control(Control(Command.RESUME))
                lose_a_ticket(owner)
            if isinstance(event, EpisodeAbsorbed) and event.index + 1 == dies_after:
                return


def lose_a_ticket(owner: Owner) -> None:
    now_secs = time.monotonic()
    issued = owner.issue(TicketRequest("actor-9", "inc-9", "nonce"), now_secs)
    assert issued is not None
    issued[1].result()
    owner.expire_leases(now_secs + LEASE_SECS + 1.0)


def record(folder: RunFolder, preset: Preset) -> None:
    """What two recorders would have kept: of the live traffic, three metrics are missing."""
    folder.recording.mkdir()
    with JournalReader(folder.journal) as journal:
        entries = list(journal)
    half = len(entries) // 2
    with Recording(folder.recording, folder.run, "rec-1") as recording:
        recording.add_live(Presence("evaluator", "evaluator", is_alive=True))
        for entry in entries[:half]:
            recording.add_entry(entry)
        recording.add_live(learner_metrics(0))
        recording.finish()
    store = SnapshotStore(folder.snapshots)
    with Recording(folder.recording, folder.run, "rec-2") as recording:
        for version in store.versions():
            weights = store.get(version)
            assert weights is not None
            digest = weights_digest(weights)
            recording.add_snapshot(Snapshot(version, 1, preset.network, weights, digest))
        for entry in entries[half:]:
            recording.add_entry(entry)
        recording.add_live(learner_metrics(4))
        recording.add_live(Presence("evaluator", "evaluator", is_alive=False))
        recording.finish()


def learner_metrics(sequence: int) -> Metrics:
    numbers = {"policy_version": 2.0, "update_secs": 0.25}
    return Metrics("owner", "learner", "epoch-2", sequence, 4, numbers)
