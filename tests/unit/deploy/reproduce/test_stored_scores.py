"""Last policies on stored initial states: played once, kept, and counted seed by seed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from actors.envs.stored_states import StoredStates, read_stored_states, write_stored_states
from broker_config.errors import PresetError, StorageError
from deploy.reproduce import catalogue, command, stored_scores
from deploy.reproduce.chapter4 import BID, CLONING
from deploy.reproduce.command import CURVES, PAGE, SCORES
from deploy.reproduce.experiment import Experiment, Panel, with_changes
from deploy.reproduce.runs import read_runs
from deploy.reproduce.side_by_side import finish_runs
from deploy.reproduce.stored_scores import (
    StoredScore,
    read_scores,
    score_last_policies,
    successes_of,
    write_scores,
)
from deploy.reproduce.stored_states_section import stored_states_section
from deploy.reproduce.work_folder import policy_file
from learner.steps.compute import ON_CPU

torch.set_num_threads(1)  # as the runs' own processes have

FOLDING = Experiment(
    name="folding",
    title="A short folding",
    source="table 0",
    published="It folds.",
    preset="shirt-ch4",
    panels=(Panel("trousers", (BID, CLONING), 1, mistake_rate=0.0, preset="trousers-ch4"),),
    overrides=(
        "schedule.iterations=1",
        "schedule.episodes_per_iteration=1",
        "schedule.target_switches=1",
        "imitation.discriminator_epochs=1",
        "imitation.generator_epochs=1",
    ),
    measures=("greedy_successes",),
)


@pytest.fixture(scope="module")
def few_states(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two flat trousers and a rotated one."""
    whole = read_stored_states("trousers")
    chosen = [whole.names.index("flat"), whole.names.index("flat") + 1]
    chosen.append(whole.names.index("rotated"))
    path = tmp_path_factory.mktemp("states") / "few.npz"
    states = StoredStates(
        whole.task,
        whole.garment,
        whole.mesh_digest,
        tuple(whole.names[number] for number in chosen),
        whole.seeds[chosen],
        whole.vertices_m[chosen],
    )
    write_stored_states(path, states)
    return path


def folding_on(states: Path | str) -> Experiment:
    panels = tuple(replace(panel, stored_states=str(states)) for panel in FOLDING.panels)
    return replace(FOLDING, panels=panels)


def score_of(seed: int, successes: list[bool], state: str = "flat") -> StoredScore:
    experiment = folding_on("trousers")
    key = experiment.plan(experiment.panels[0], BID, seed).key
    return StoredScore(key, "digest", state, tuple(successes), tuple(map(float, successes)))


def test_one_command_scores_last_policies_once(
    tmp_path: Path, few_states: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment = folding_on(few_states)
    monkeypatch.setitem(catalogue.EXPERIMENTS, "folding", experiment)
    monkeypatch.setattr(command.sys, "argv", ["clothbus", "reproduce", "folding"])
    places = {"output": tmp_path / "docs", "work": tmp_path / "work"}
    command.reproduce("folding", **places)
    scores = read_scores(tmp_path / "docs" / SCORES)
    assert [(it.run.condition, it.initial_state, len(it.successes)) for it in scores] == [
        ("cloning", "flat", 2),
        ("cloning", "rotated", 1),
        ("pgail-bid", "flat", 2),
        ("pgail-bid", "rotated", 1),
    ]
    # Trousers half folded or not at all cover a part of the target.
    assert all(return_ > 0 for score in scores for return_ in score.returns)
    page = (tmp_path / "docs" / PAGE).read_text()
    assert "| initial state | PGAIL-BiD | behaviour cloning |" in page
    assert "| difference of success |" in page
    assert "* Preset `trousers-ch4`" in page

    def play_again(*_: object) -> None:
        pytest.fail("what was scored is scored again")

    monkeypatch.setattr(stored_scores, "_score", play_again)
    command.reproduce("folding", **places)
    assert read_scores(tmp_path / "docs" / SCORES) == scores
    command.reproduce("folding", draw_only=True, **places)
    assert (tmp_path / "docs" / PAGE).read_text() == page


def test_a_run_whose_policy_was_left_elsewhere_is_made_again_to_be_scored(
    tmp_path: Path, few_states: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever clones the repository has curves and no policies."""
    monkeypatch.setitem(catalogue.EXPERIMENTS, "folding", folding_on(few_states))
    docs, asked = tmp_path / "docs", {"conditions": ("cloning",)}
    command.reproduce("folding", output=docs, work=tmp_path / "here", **asked)
    curves, scores = read_runs(docs / CURVES), read_scores(docs / SCORES)
    (docs / SCORES).unlink()
    command.reproduce("folding", output=docs, work=tmp_path / "there", **asked)
    assert read_scores(docs / SCORES) == scores
    (again,), (first,) = read_runs(docs / CURVES), curves
    assert (again.key, again.greedy_returns) == (first.key, first.greedy_returns)
    assert (tmp_path / "there" / "folding" / "policies").is_dir()


def test_only_runs_that_have_ended_are_scored(tmp_path: Path, few_states: Path) -> None:
    experiment = folding_on(few_states)
    plans = [experiment.plan(experiment.panels[0], condition, 0) for condition in (BID, CLONING)]
    runs = finish_runs(plans, tmp_path / CURVES, tmp_path, ON_CPU, 1, iterations=0)
    score_last_policies(experiment, runs, tmp_path / SCORES, tmp_path, 1)
    assert {it.run.condition for it in read_scores(tmp_path / SCORES)} == {"cloning"}


def test_a_policy_that_has_changed_is_scored_again(tmp_path: Path, few_states: Path) -> None:
    experiment = with_changes(folding_on(few_states), seeds=2)
    plans = [experiment.plan(experiment.panels[0], CLONING, seed) for seed in range(2)]
    runs = finish_runs(plans, tmp_path / CURVES, tmp_path, ON_CPU, 1, None)

    def digests() -> list[str | None]:
        score_last_policies(experiment, runs, tmp_path / SCORES, tmp_path, 1)
        scores = [it for it in read_scores(tmp_path / SCORES) if it.initial_state == "flat"]
        assert [it.run for it in scores] == [plan.key for plan in plans]
        return [it.policy for it in scores]

    first, other = digests()
    assert digests() == [first, other], "nothing has changed"
    policy_file(tmp_path, plans[0]).write_bytes(policy_file(tmp_path, plans[1]).read_bytes())
    assert digests() == [other, other]
    policy_file(tmp_path, plans[0]).unlink()
    assert digests() == [other, other], "it is known"


def test_a_policy_that_is_gone_is_named(tmp_path: Path, few_states: Path) -> None:
    experiment = folding_on(few_states)
    plan = experiment.plan(experiment.panels[0], CLONING, 0)
    finish_runs([plan], tmp_path / CURVES, tmp_path, ON_CPU, 1, None)
    runs = read_runs(tmp_path / CURVES)
    with pytest.raises(StorageError, match=r"expected the last policy of cloning-0-"):
        score_last_policies(experiment, runs, tmp_path / SCORES, tmp_path / "elsewhere", 1)
    with pytest.raises(PresetError, match="or one of handkerchief"):
        score_last_policies(folding_on("socks"), [], tmp_path / SCORES, tmp_path, 1)


def test_scores_survive_the_file(tmp_path: Path) -> None:
    path = tmp_path / SCORES
    assert read_scores(path) == []
    scores = [score_of(1, [True]), score_of(0, [False, True])]
    write_scores(path, scores)
    assert read_scores(path) == scores[::-1]
    path.write_text(path.read_text() + "{}\n")
    with pytest.raises(StorageError, match="got line 3"):
        read_scores(path)


def test_trials_are_counted_seed_by_seed() -> None:
    scores = [
        score_of(1, [True, True]),
        score_of(0, [False, True]),
        score_of(0, [False], "creased"),
        score_of(1, [True], "creased"),
    ]
    assert successes_of(scores, "flat").tolist() == [[0, 1], [1, 1]]
    assert successes_of(scores).tolist() == [[0, 1, 0], [1, 1, 1]]
    section = stored_states_section(
        Panel("p", (BID, CLONING), 2, stored_states="trousers"),
        {
            "pgail-bid": scores,
            "cloning": [replace(it, successes=(False,) * len(it.successes)) for it in scores],
        },
    )
    assert "| flat | 75% (25% to 100%), 3/4 | 0% (all agree), 0/4 |" in section
    assert "| creased | 50% (0% to 100%), 1/2 |" in section
    assert "| all | 67% (17% to 100%), 4/6 |" in section
    assert "| PGAIL-BiD - behaviour cloning | +0.33, +1.00 | +0.67 | +0.33 to +1.00 |" in section


def test_without_scores_there_is_no_section() -> None:
    assert stored_states_section(FOLDING.panels[0], {}) == ""
