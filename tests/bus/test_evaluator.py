"""The evaluator on a real bus, in this process, against an owner made of a few handlers."""

from __future__ import annotations

import dataclasses
import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from broker_config.bus import Bus
from broker_config.errors import AttachRefused, StorageError
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import (
    Attach,
    Heartbeat,
    Metrics,
    Refusal,
    Snapshot,
    SnapshotRequest,
    Welcome,
    weights_digest,
)
from broker_config.queries import Responder
from deploy.evaluation.evaluate import evaluate
from deploy.evaluation.evaluator import Evaluator
from deploy.evaluation.scores import WAITING_FOR_OWNER, Results, read_results
from deploy.presets import load_preset
from deploy.run_folder import RunFolder, prepare_run_folder
from learner.snapshots import SnapshotStore
from learner.trainer import Trainer
from tests.conftest import until_declared

PRESET = load_preset("reaching-smoke", ["schedule.iterations=3"])
"""Versions 0, 2, 4 and 6 are the ends of its iterations."""

EPISODES = 2


def weights_of(version: int) -> bytes:
    return Trainer(load_preset("reaching-smoke", [f"seed={version}"])).weights_bytes()


class FakeOwner:
    """Lets evaluators join, publishes versions and gives out older ones."""

    def __init__(self, bus: Bus, preset_json: str = PRESET.to_json()) -> None:
        self._bus = bus
        self.asked_versions: list[int] = []
        self.gone_versions: set[int] = set()
        self.refusal: Refusal | None = None
        self.epoch = 1
        self._preset_json = preset_json
        self._policies = bus.latest_publisher(bus.keys.policy)
        self._beats = bus.publisher(bus.keys.live("owner", "learner"))
        bus.serve(bus.keys.every(Kind.ATTACH), Attach, self._attach)
        bus.serve(bus.keys.every(Kind.POLICY_VERSION), SnapshotRequest, self._snapshot)

    def publish(self, version: int) -> None:
        self._policies.put(self.snapshot(version))

    def beat(self, state: str, version: int) -> None:
        numbers = {"policy_version": float(version)}
        self._beats.put(Heartbeat("owner", "learner", "epoch-1", "host", 1, state, 0.0, numbers))

    def snapshot(self, version: int) -> Snapshot:
        weights = weights_of(version)
        return Snapshot(version, self.epoch, PRESET.network, weights, weights_digest(weights))

    def _attach(self, _: ParsedKey, request: Attach, to: Responder) -> None:
        to.reply(self.refusal or Welcome("run", self.epoch, self._preset_json))

    def _snapshot(self, _: ParsedKey, request: SnapshotRequest, to: Responder) -> None:
        self.asked_versions.append(request.version)
        if request.version in self.gone_versions:
            to.reply(Refusal("policy version", "another", str(request.version), "do without"))
            return
        to.reply(self.snapshot(request.version))


class RunningEvaluator:
    """An evaluator on a thread of its own."""

    def __init__(self, evaluator: Evaluator) -> None:
        self.evaluator = evaluator
        self.outcome: bool | Exception | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.outcome = self.evaluator.run()
        except Exception as error:
            self.outcome = error

    def join(self) -> bool | Exception | None:
        self._thread.join(60)
        assert not self._thread.is_alive(), self.evaluator.state
        return self.outcome


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder(tmp_path / "output")


@pytest.fixture
def launch(attach: Any, folder: RunFolder) -> Iterator[Callable[[], RunningEvaluator]]:
    started: list[RunningEvaluator] = []

    def start() -> RunningEvaluator:
        bus = attach("evaluator", "evaluator")
        incarnation = f"life-{len(started)}"
        started.append(RunningEvaluator(Evaluator(bus, "evaluator", incarnation, folder, EPISODES)))
        return started[-1]

    yield start
    for running in started:
        running.evaluator.stop()
        running.join()


def finished_scores(folder: RunFolder) -> Counter[tuple[int, str]]:
    return Counter((it.version, it.mode) for it in read_results(folder.evaluation))


def test_every_iteration_s_policy_is_fetched_and_the_last_is_scored_to_its_end(
    attach: Any,
    folder: RunFolder,
    launch: Callable[[], RunningEvaluator],
    wait_until: Callable[..., None],
) -> None:
    owner = FakeOwner(attach("owner", "learner"))
    observer, heard = attach("observer", "test"), []
    pattern = observer.keys.every(Kind.METRICS)
    observer.subscribe(pattern, Metrics, lambda _, metrics: heard.append(metrics))
    until_declared(observer)
    owner.publish(3)
    running = launch()
    wait_until(lambda: len(read_results(folder.evaluation)) == 8, "2 and 0 are scored")
    assert [it.version for it in read_results(folder.evaluation)] == [2] * 4 + [0] * 4
    assert set(owner.asked_versions) == {0, 2}, "3 ends no iteration"
    owner.publish(6)
    assert running.join() is True
    scores = finished_scores(folder)
    assert scores[6, "sampled"] == scores[6, "greedy"] == EPISODES
    assert SnapshotStore(folder.snapshots).get(6) == weights_of(6)
    wait_until(lambda: any(it.step == 6 for it in heard), "the last score is announced")
    last = [it for it in heard if it.step == 6][-1]
    assert last.numbers["version"] == 6
    (expected,) = evaluate(folder, (6,), EPISODES, "greedy", jobs=1)
    assert last.numbers["greedy/return"] == expected.mean_return
    assert last.numbers["greedy/return_low"] == expected.return_interval[0]
    assert max(scores.values()) == EPISODES
    sequences = [it.sequence for it in heard]
    assert sequences == list(range(len(heard)))


def test_what_it_plays_is_what_an_evaluation_afterwards_plays(
    attach: Any, folder: RunFolder, launch: Callable[[], RunningEvaluator], tmp_path: Path
) -> None:
    owner = FakeOwner(attach("owner", "learner"))
    owner.publish(6)
    assert launch().join() is True
    afterwards = prepare_run_folder(tmp_path / "afterwards", PRESET)
    SnapshotStore(afterwards.snapshots).put(6, weights_of(6))
    for mode in ("sampled", "greedy"):
        evaluate(afterwards, (6,), EPISODES, mode, jobs=1)
    live = [it for it in read_results(folder.evaluation) if it.version == 6]
    assert live == read_results(afterwards.evaluation)
    assert len({it.return_ for it in live}) > EPISODES, "the two modes differ, and the seeds do"


def test_a_run_that_was_stopped_early_ends_with_its_newest_policy(
    attach: Any,
    folder: RunFolder,
    launch: Callable[[], RunningEvaluator],
    wait_until: Callable[..., None],
) -> None:
    owner = FakeOwner(attach("owner", "learner"))
    owner.gone_versions = {0}
    owner.publish(5)
    running = launch()
    wait_until(lambda: 4 in owner.asked_versions, "it fetches 4")
    owner.beat("learning", 5)
    while running.outcome is None:
        owner.beat("finished, waits for recorder", 5)
        running._thread.join(0.2)
    assert running.join() is True
    scores = finished_scores(folder)
    assert scores[4, "sampled"] == scores[4, "greedy"] == EPISODES
    assert scores[0, "sampled"] == 0
    assert owner.asked_versions.count(0) == 1, "what is gone is asked for once"


def test_the_policies_of_another_run_are_refused(
    attach: Any, folder: RunFolder, launch: Callable[[], RunningEvaluator]
) -> None:
    prepare_run_folder(folder.path, PRESET)
    SnapshotStore(folder.snapshots).put(4, weights_of(1))
    owner = FakeOwner(attach("owner", "learner"))
    owner.publish(4)
    outcome = launch().join()
    assert isinstance(outcome, StorageError)
    assert "choose another folder for this run" in str(outcome)


def test_another_preset_s_folder_is_refused(
    attach: Any, folder: RunFolder, launch: Callable[[], RunningEvaluator]
) -> None:
    prepare_run_folder(folder.path, dataclasses.replace(PRESET, seed=9))
    FakeOwner(attach("owner", "learner"))
    assert "expected a run of preset" in str(launch().join())


def test_another_version_s_owner_refuses_it_in_words(
    attach: Any, launch: Callable[[], RunningEvaluator]
) -> None:
    owner = FakeOwner(attach("owner", "learner"))
    owner.refusal = Refusal("clothbus version", "2", "1", "install the same version")
    outcome = launch().join()
    assert isinstance(outcome, AttachRefused)
    assert "clothbus version: expected 2; got 1" in str(outcome)


def test_it_waits_for_an_owner_and_for_whoever_evaluates_already(
    attach: Any,
    folder: RunFolder,
    launch: Callable[[], RunningEvaluator],
    wait_until: Callable[..., None],
) -> None:
    running = launch()
    wait_until(lambda: running.evaluator.state == WAITING_FOR_OWNER, "it waits for an owner")
    with Results(folder.evaluation):
        owner = FakeOwner(attach("owner", "learner"))
        owner.publish(6)
        wait_until(lambda: "expected no other owner" in running.evaluator.state, "it waits")
        assert read_results(folder.evaluation) == []
    assert running.join() is True
    assert finished_scores(folder)[6, "greedy"] == EPISODES


def test_a_complete_run_needs_no_owner_and_what_is_left_is_named(
    folder: RunFolder, launch: Callable[[], RunningEvaluator], caplog: pytest.LogCaptureFixture
) -> None:
    prepare_run_folder(folder.path, PRESET)
    for version in (2, 4, 6):
        SnapshotStore(folder.snapshots).put(version, weights_of(version))
    with caplog.at_level(logging.INFO):
        assert launch().join() is True
    for mode in ("sampled", "greedy"):
        assert f"--mode {mode} --episodes 2 --versions 2 4 scores them" in caplog.text
    assert finished_scores(folder) == {(6, "sampled"): EPISODES, (6, "greedy"): EPISODES}


def test_a_restarted_owner_is_asked_again_whether_it_is_the_same_run(
    attach: Any,
    folder: RunFolder,
    launch: Callable[[], RunningEvaluator],
    wait_until: Callable[..., None],
) -> None:
    owner = FakeOwner(attach("owner", "learner"))
    owner.publish(0)
    running = launch()
    wait_until(lambda: finished_scores(folder)[0, "greedy"] == EPISODES, "0 is scored")
    owner.refusal = Refusal("preset digest", "ours", "yours", "use ours")
    owner.epoch = 2
    owner.publish(1)
    outcome = running.join()
    assert isinstance(outcome, AttachRefused)
    assert finished_scores(folder)[0, "sampled"] == EPISODES


def test_asked_to_leave_it_leaves_at_the_next_step(
    attach: Any, folder: RunFolder, launch: Callable[[], RunningEvaluator], wait_until: Any
) -> None:
    owner = FakeOwner(attach("owner", "learner"))
    owner.publish(0)
    running = launch()
    wait_until(lambda: running.evaluator.state.startswith("evaluating"), "it plays")
    running.evaluator.stop()
    assert running.join() is False
    assert max(Counter(it.key for it in read_results(folder.evaluation)).values(), default=1) == 1
