"""Evaluation: seeds of its own, intervals, and the same result with any number of jobs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from broker_config.errors import StorageError
from deploy.evaluate import bootstrap_interval, evaluate
from deploy.presets import load_preset
from deploy.run_folder import RunFolder, create_run_folder
from learner.snapshots import SnapshotStore
from learner.trainer import Trainer


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    preset = load_preset("reaching-smoke")
    folder = create_run_folder(tmp_path, preset)
    store = SnapshotStore(folder.snapshots)
    for version in (0, 3):
        store.put(version, Trainer(preset).weights_bytes())
    return folder


def test_the_first_and_the_last_version_play_the_same_seeds(folder: RunFolder) -> None:
    first, last = evaluate(folder, (), episodes=4, mode="sampled", jobs=1)
    assert (first.version, last.version) == (0, 3)
    assert first.returns == last.returns  # the same weights, here
    assert len(set(first.returns)) > 1
    low, high = first.return_interval
    assert low < first.mean_return < high


def test_an_evaluation_goes_on_where_it_was(folder: RunFolder) -> None:
    evaluate(folder, (0,), 2, "greedy", jobs=1)
    lines = folder.evaluation.read_text().splitlines()
    first = json.loads(lines[0])
    folder.evaluation.write_text(json.dumps({**first, "return_": 123.0}) + "\n")
    with folder.evaluation.open("a") as file:
        file.write('{"version": 0, "mo')  # killed while writing
    (score,) = evaluate(folder, (0,), 2, "greedy", jobs=1)
    assert score.returns == (123.0, json.loads(lines[1])["return_"])


def test_a_file_of_something_else_is_refused(folder: RunFolder) -> None:
    folder.evaluation.write_text("{}\n")
    with pytest.raises(StorageError, match="expected evaluation episodes"):
        evaluate(folder, (0,), 1, "greedy", jobs=1)


def test_jobs_do_not_change_the_result(folder: RunFolder) -> None:
    alone = evaluate(folder, (0,), 4, "sampled", jobs=1)
    folder.evaluation.unlink()
    assert evaluate(folder, (0,), 4, "sampled", jobs=2) == alone


def test_a_version_that_is_not_there_is_named_with_those_that_are(folder: RunFolder) -> None:
    with pytest.raises(StorageError, match="expected one of 0, 3; got 7"):
        evaluate(folder, (7,), 1, "greedy", jobs=1)


def test_the_bootstrap_interval_holds_the_mean_as_often_as_it_says() -> None:
    generator = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        low, high = bootstrap_interval(generator.normal(5.0, 2.0, 30).tolist(), seed=0)
        hits += low < 5.0 < high
    assert 0.88 < hits / 200 < 0.99
