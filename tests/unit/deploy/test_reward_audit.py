"""Rewards are those of the discriminators that they name, or the audit says so."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from actors.task import make_task_env
from broker_config.codec import decode, encode
from broker_config.errors import StorageError
from broker_config.journal import Journal, JournalReader
from broker_config.messages import Rewards
from broker_config.preset import Preset
from deploy.demonstrations.demonstrators import by_script
from deploy.demonstrations.making import make_demonstrations
from deploy.presets import load_preset
from deploy.rewards.audit import audit_rewards
from deploy.rewards.timeline import recorded_timelines
from deploy.run_folder import RunFolder, prepare_run_folder
from deploy.running.in_process import InProcessActor, InProcessDiscriminators
from learner.checkpoint import CheckpointStore
from learner.learning import IterationLabelled, LearningLoop, RewardsAwaited
from learner.owner import Owner
from learner.snapshots import SnapshotStore
from learner.trainer import Trainer

torch.set_num_threads(1)

PRESET = load_preset("imitation-smoke", ["schedule.iterations=2"])
SQIL = load_preset("imitation-smoke", ["algorithm.method=sqil", "algorithm.sigma=0.0"])


def imitate(folder: RunFolder, preset: Preset) -> list[object]:
    """A whole run in this process; returns what happened."""
    demonstrations = make_demonstrations(
        preset, folder.path / "demonstrations", 3, by_script(preset, 0.0)
    )
    with Journal(folder.journal) as journal, closing(make_task_env(preset.task)) as env:
        owner = Owner(folder.run, preset, journal)
        snapshots = SnapshotStore(folder.snapshots)
        loop = LearningLoop(
            owner,
            Trainer(preset),
            CheckpointStore(folder.checkpoints),
            snapshots,
            demonstrations,
            InProcessActor(owner, env, snapshots).play_until_ready,
            InProcessDiscriminators(owner, journal).wait_rewards,
        )
        return list(loop)


@pytest.fixture(scope="module")
def imitated(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    folder = prepare_run_folder(tmp_path_factory.mktemp("imitated") / "run", PRESET)
    events = imitate(folder, PRESET)
    assert [it.iteration for it in events if isinstance(it, RewardsAwaited)] == [0, 1]
    labelled = [it.rewards.iteration for it in events if isinstance(it, IterationLabelled)]
    assert labelled == [0, 1]
    return folder


def changed(folder: RunFolder, path: Path, change: Callable[[Rewards], Rewards]) -> Path:
    """A copy of a run's journal in which the last iteration's rewards are others."""
    copy = prepare_run_folder(path, PRESET)
    with JournalReader(folder.journal) as before, Journal(copy.journal) as after:
        for entry in before:
            payload = entry.payload
            if entry.name == "rewards/1":
                payload = encode(change(decode(payload, Rewards)))
            after.append([(entry.name, payload)]).result(10)
    return copy.path


def test_rewards_and_training_come_out_again_bit_for_bit(imitated: RunFolder) -> None:
    audited = list(audit_rewards(imitated.path, retrained=True))
    assert [(it.iteration, it.expert_version, it.target_version) for it in audited] == [
        (0, 1, 1),
        (1, 2, 2),
    ]
    assert [it.samples for it in audited] == [36, 72]
    assert all(it.largest_difference == 0 and it.same_training for it in audited)
    assert all(it.same_training is None for it in audit_rewards(imitated.path))


def test_rewards_that_were_changed_are_found(imitated: RunFolder, tmp_path: Path) -> None:
    def one_more(rewards: Rewards) -> Rewards:
        values = rewards.rewards.copy()
        values[5] += 0.5
        return replace(rewards, rewards=values)

    first, second = audit_rewards(changed(imitated, tmp_path / "run", one_more), retrained=True)
    assert first.is_sound
    assert not second.is_sound
    assert second.largest_difference == pytest.approx(0.5)
    assert second.same_training, "only the rewards were changed"


def test_another_state_is_found(imitated: RunFolder, tmp_path: Path) -> None:
    with JournalReader(imitated.journal) as journal:
        entry = journal.find("rewards/0")
    assert entry is not None
    earlier = decode(entry.payload, Rewards)

    def of_before(rewards: Rewards) -> Rewards:
        return replace(rewards, state=earlier.state, state_digest=earlier.state_digest)

    source = changed(imitated, tmp_path / "run", of_before)
    _, second = audit_rewards(source, retrained=True)
    assert not second.is_sound
    assert second.same_training is False


def test_a_run_without_discriminators_has_nothing_to_audit(tmp_path: Path) -> None:
    folder = prepare_run_folder(tmp_path / "run", SQIL)
    events = imitate(folder, SQIL)
    assert not any(isinstance(it, RewardsAwaited) for it in events)
    with pytest.raises(StorageError, match="expected a run in which discriminators have given"):
        list(audit_rewards(folder.path))


def test_a_timeline_scores_the_run_s_own_episodes(imitated: RunFolder) -> None:
    first, last = recorded_timelines(imitated.path, (), None)
    assert first.title == "episode 0, discriminators of iteration 1"
    assert last.title == "episode 5, discriminators of iteration 1"
    assert {name: len(it) for name, it in last.rewards.items()} == {"expert": 12, "target": 12}
    (earlier,) = recorded_timelines(imitated.path, (5,), 0)
    assert not np.array_equal(earlier.rewards["expert"], last.rewards["expert"])
    with pytest.raises(StorageError, match="expected rewards of iteration 7"):
        recorded_timelines(imitated.path, (), 7)
