"""Evaluation: seeds of its own, intervals, and the same result with any number of jobs."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.envs.stored_states import read_stored_states, write_stored_states
from actors.policy import Policy
from broker_config.errors import AlreadyOwned, PresetError, StorageError
from deploy.evaluation import player
from deploy.evaluation.evaluate import evaluate, evaluate_on_stored_states, stored_score_table
from deploy.evaluation.evaluator import next_episode
from deploy.evaluation.player import Player
from deploy.evaluation.scores import (
    Episode,
    Results,
    bootstrap_interval,
    modes_of,
    read_results,
    scores_of,
)
from deploy.presets import load_preset
from deploy.run_folder import RunFolder, create_run_folder
from deploy.tasks.make_states import make_states
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


def test_dqn_has_no_sampled_mode(tmp_path: Path) -> None:
    preset = load_preset("reaching-smoke", ["algorithm.method='dqn'"])
    assert modes_of(preset.algorithm) == ("greedy",)
    with pytest.raises(PresetError, match="expected mode greedy; got sampled"):
        evaluate(create_run_folder(tmp_path, preset), (0,), 1, "sampled", jobs=1)


def test_one_process_at_a_time_evaluates_a_run(folder: RunFolder) -> None:
    with Results(folder.evaluation), pytest.raises(AlreadyOwned, match=f"pid {os.getpid()} on"):
        evaluate(folder, (0,), 1, "greedy", jobs=1)
    assert len(evaluate(folder, (0,), 1, "greedy", jobs=1)) == 1


# Stored states --------------------------------------------------------------------------------

COARSE = {"spacing_m": 0.05, "start_shift_m": 0.01}


@pytest.fixture
def flipping(tmp_path: Path) -> RunFolder:
    """An untrained run, and its two versions."""
    settings = ["task.horizon=2", "task.options.spacing_m=0.05"]
    preset = load_preset("handkerchief-quickstart", settings)
    folder = create_run_folder(tmp_path, preset)
    store = SnapshotStore(folder.snapshots)
    for version in (0, 3):
        store.put(version, Trainer(preset).weights_bytes())
    return folder


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    path = tmp_path / "states.npz"
    made = make_states("clothbus/HandkerchiefFlip36-v0", COARSE, ("flat", "folded_over"), 3)
    write_stored_states(path, made)
    return path


def test_each_stored_state_is_played_once_and_scored_by_its_name(
    flipping: RunFolder, stored: Path
) -> None:
    def score(names: tuple[str, ...], episodes: int | None = None) -> dict[str, Any]:
        return evaluate_on_stored_states(flipping, (), str(stored), names, "greedy", 1, episodes)

    by_state = score(())
    assert list(by_state) == ["flat", "folded_over"]
    for first, last in by_state.values():
        assert (first.version, last.version, first.episodes) == (0, 3, 3)
        assert first.returns == last.returns  # the same weights, here
    assert stored_score_table(by_state).row_count == 4
    assert not flipping.evaluation.exists(), "scores from seeds are another matter"
    results = flipping.stored_evaluation(read_stored_states(str(stored)).digest)
    before = results.read_bytes()
    (few, _) = score(("folded_over",), episodes=2)["folded_over"]
    assert few.returns == by_state["folded_over"][0].returns[:2]
    assert results.read_bytes() == before, "what was played is not played again"


def test_an_episode_from_a_stored_state_that_the_guard_ends_has_failed(
    flipping: RunFolder, stored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def collect_guarded(*arguments: Any) -> Any:
        trajectory = collect(*arguments)
        object.__setattr__(trajectory, "guard", next(guards))
        object.__setattr__(trajectory, "success", False)
        return trajectory

    collect, guards = player.collect, iter(["engine_lost", "overstretched"])
    monkeypatch.setattr(player, "collect", collect_guarded)
    preset = flipping.read_preset()
    policy = Policy(preset.network, Trainer(preset).weights())
    episode = Player(preset, str(stored)).play(policy, 0, "greedy", 4)
    assert (episode.number, episode.success) == (4, False)
    assert next(guards, None) is None


def test_stored_states_that_cannot_be_played_are_refused(
    flipping: RunFolder, folder: RunFolder, stored: Path
) -> None:
    def refused(run: RunFolder, source: str, complaint: str, *names: str, many: int = 1) -> None:
        with pytest.raises(PresetError, match=complaint):
            evaluate_on_stored_states(run, (0,), source, names, "greedy", 1, many)

    refused(flipping, str(stored), "expected at least 4 flat; got 3; there are flat, fol", many=4)
    refused(flipping, str(stored), "expected at least 1 creased; got 0", "creased")
    refused(flipping, "socks", "or one of handkerchief, shirt, trousers; got 'socks'")
    refused(flipping, "shirt", "expected states of this garment, handkerchief")
    refused(folder, str(stored), "got stored_states; leave out what this task lacks")


# The file -------------------------------------------------------------------------------------


def episode(number: int, version: int = 0) -> Episode:
    return Episode(version, "sampled", number, number / 8, success=number % 2 == 0)


def test_a_line_that_is_torn_at_any_byte_is_cut_off_and_written_again(tmp_path: Path) -> None:
    path = tmp_path / "evaluation.jsonl"
    with Results(path) as results:
        results.add(episode(0))
        one_bytes = path.stat().st_size
        results.add(episode(1))
    whole = path.read_bytes()
    for size_bytes in range(one_bytes, len(whole)):
        path.write_bytes(whole[:size_bytes])
        assert read_results(path) == [episode(0)]
        assert path.stat().st_size == size_bytes, "who only reads leaves the file alone"
        with Results(path) as results:
            assert list(results.episodes.values()) == [episode(0)]
            results.add(episode(1))
        assert path.read_bytes() == whole


def test_a_full_disk_leaves_the_file_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "evaluation.jsonl"

    def write_half(file: int, data: bytes, offset: int) -> int:
        return really_write(file, data[: len(data) // 2], offset)

    really_write = os.pwrite
    with Results(path) as results:
        results.add(episode(0))
        before = path.read_bytes()
        with monkeypatch.context() as patch:
            patch.setattr(os, "pwrite", write_half)
            with pytest.raises(StorageError, match="No space left on device"):
                results.add(episode(1))
        assert path.read_bytes() == before
        assert episode(1).key not in results.episodes
        results.add(episode(1))
    assert read_results(path) == [episode(0), episode(1)]


def test_a_score_needs_all_of_its_episodes(tmp_path: Path) -> None:
    with Results(tmp_path / "evaluation.jsonl") as results:
        for number in (0, 2):
            results.add(episode(number))
        assert results.score(0, "sampled", 3, seed=0) is None
        results.add(episode(1))
        score = results.score(0, "sampled", 3, seed=0)
        assert score is not None
        assert score.returns == (0.0, 1 / 8, 2 / 8)
        assert score.success_rate == pytest.approx(2 / 3)
        assert score.numbers["sampled/return"] == pytest.approx(1 / 8)
        assert results.score(0, "greedy", 3, seed=0) is None
    mixed = scores_of([episode(1, version=4), episode(0), episode(0, version=4)], seed=0)
    assert [(it.version, it.returns) for it in mixed] == [(0, (0.0,)), (4, (0.0, 1 / 8))]


# The order ------------------------------------------------------------------------------------


def test_the_newest_version_is_scored_first_then_what_is_missing_of_older_ones() -> None:
    played: dict[Any, Episode] = {}
    order = []
    while wanted := next_episode([4, 2], ["sampled", "greedy"], 2, played):
        order.append(wanted)
        played[wanted] = Episode(*wanted, 0.0, success=False)
        if len(order) == 3:
            break
    while wanted := next_episode([6, 4, 2], ["sampled", "greedy"], 2, played):
        order.append(wanted)
        played[wanted] = Episode(*wanted, 0.0, success=False)
    assert [version for version, _, _ in order] == [4, 4, 4, 6, 6, 6, 6, 4, 2, 2, 2, 2]
    assert len(set(order)) == len(order)
    assert [mode for _, mode, _ in order[3:7]] == ["sampled", "sampled", "greedy", "greedy"]


def test_a_lost_simulator_does_not_change_the_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    preset = load_preset("reaching-smoke")
    policy = Policy(preset.network, Trainer(preset).weights())
    expected = Player(preset).play(policy, 0, "sampled", 3)
    losses = iter(["engine_lost"] * 4)

    def collect_with_losses(*arguments: Any) -> Any:
        trajectory = collect(*arguments)
        object.__setattr__(trajectory, "guard", next(losses, None))
        return trajectory

    collect = player.collect
    monkeypatch.setattr(player, "collect", collect_with_losses)
    assert Player(preset).play(policy, 0, "sampled", 3) == expected
    assert next(losses, None) is None
    losses = iter(["overstretched"])
    assert Player(preset).play(policy, 0, "sampled", 3) != expected
