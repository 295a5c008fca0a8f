"""Last policies in worlds that they have not learned in: played once, kept, and tabulated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from broker_config.errors import AlreadyOwned, PresetError, StorageError
from broker_config.ownership import FileLock
from broker_config.preset import with_settings
from deploy.reproduce import catalogue, command, transfer
from deploy.reproduce.catalogue import TRANSFER_TABLES
from deploy.reproduce.chapter4 import BID, CLONING
from deploy.reproduce.command import PAGE, WORLDS
from deploy.reproduce.experiment import Experiment, KeptPolicies, Panel, TransferTable, World
from deploy.reproduce.json_lines import read_lines
from deploy.reproduce.transfer import CHANCE, SCRIPT, Trial, WorldScore

torch.set_num_threads(1)  # as the runs' own processes have

FOLDING = Experiment(
    name="folding",
    title="A short folding",
    source="table 0",
    published="It folds.",
    preset="trousers-ch4",
    panels=(Panel("trousers", (BID, CLONING), 2, mistake_rate=0.0),),
    overrides=("imitation.generator_epochs=1", "schedule.target_switches=1"),
    measures=("greedy_successes",),
)
ELSEWHERE = TransferTable(
    name="elsewhere",
    title="Elsewhere",
    source="table 0",
    published="nothing",
    policies=(KeptPolicies("folding", "trousers", ("pgail-bid", "cloning")),),
    worlds=(
        World("as trained"),
        World("larger or smaller", ("task.options.randomisation=held_out",)),
    ),
    episodes=2,
    notes=("A test.",),
)


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(catalogue.EXPERIMENTS, "folding", FOLDING)
    monkeypatch.setitem(catalogue.TRANSFER_TABLES, "elsewhere", ELSEWHERE)
    monkeypatch.setattr(command.sys, "argv", ["clothbus", "reproduce", "elsewhere"])


def make_policies(work: Path, seeds: int) -> None:
    """Of cloning, the second of two conditions."""
    command.reproduce(
        "folding", conditions=("cloning",), seeds=seeds, output=work / "docs", work=work
    )


def players_of(scores: list[WorldScore]) -> list[tuple[str, int, int]]:
    return [(it.trial.player, it.trial.seed, len(it.trial.world)) for it in scores]


def page_of(folder: Path, work: Path, **options: bool) -> str:
    command.reproduce("elsewhere", output=folder, work=work, **options)
    return (folder / PAGE).read_text()


@pytest.mark.usefixtures("known")
def test_policies_that_are_there_are_tested_once_beside_script_and_chance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, work = tmp_path / "docs", tmp_path / "work"
    with pytest.raises(StorageError, match="expected last policies of folding; got none"):
        page_of(folder, work)
    make_policies(work, seeds=1)
    page = page_of(folder, work)
    scores = read_lines(folder / WORLDS, WorldScore, "scores")
    assert players_of(scores) == [
        *[("cloning", 0, 0), (SCRIPT, 0, 0), (CHANCE, 0, 0)],
        *[("cloning", 0, 1), (SCRIPT, 0, 1), (CHANCE, 0, 1)],
    ]
    assert all(len(it.successes) == len(it.returns) == 2 for it in scores)
    assert scores[0].returns != scores[3].returns, "another world"
    assert "| world | behaviour cloning, seeds: 1 | the script | chance |" in page
    assert "| as trained |" in page
    assert "| larger or smaller |" in page
    assert "100%, 2/2" in page, "the script folds trousers"

    played: list[Trial] = []
    play = transfer._play

    def play_and_tell(work: Path, planned: transfer._Planned) -> WorldScore:
        played.append(planned.trial)
        return play(work, planned)

    monkeypatch.setattr(transfer, "_play", play_and_tell)
    assert page_of(folder, work) == page
    assert played == []
    with FileLock(work / "elsewhere.lock", "another process"):
        with pytest.raises(AlreadyOwned):
            page_of(folder, work)
        assert "100%, 2/2" in page_of(folder, work, draw_only=True), "what there is so far"

    make_policies(work, seeds=2)
    assert "| world | behaviour cloning, seeds: 2 | the script | chance |" in page_of(folder, work)
    assert [(it.player, it.seed) for it in played] == [("cloning", 1)] * 2

    # Weights that have changed under the same name are played again.
    first, second = sorted((work / "folding" / "policies").iterdir())
    first.write_bytes(second.read_bytes())
    played.clear()
    page_of(folder, work)
    assert [(it.player, it.seed) for it in played] == [("cloning", 0)] * 2

    # Nothing that is kept is shown where the table has changed.
    longer = replace(ELSEWHERE, episodes=1)
    monkeypatch.setitem(catalogue.TRANSFER_TABLES, "elsewhere", longer)
    with pytest.raises(StorageError, match="got none"):
        page_of(folder, work, draw_only=True)
    assert ", 1/1, return " in page_of(folder, work)
    monkeypatch.setitem(catalogue.TRANSFER_TABLES, "elsewhere", ELSEWHERE)
    played.clear()
    assert "seeds: 2" in page_of(folder, work)
    assert played == [], "what the other table did not ask for was kept"


@pytest.mark.usefixtures("known")
def test_a_trial_that_fails_does_not_end_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_policies(tmp_path, seeds=1)
    play = transfer._play

    def fail_for_the_script(work: Path, planned: transfer._Planned) -> WorldScore:
        if planned.trial.player == SCRIPT:
            raise StorageError("the guard ends each episode")
        return play(work, planned)

    monkeypatch.setattr(transfer, "_play", fail_for_the_script)
    with pytest.raises(StorageError, match="the guard ends each"):
        page_of(tmp_path / "docs", tmp_path)
    scores = read_lines(tmp_path / "docs" / WORLDS, WorldScore, "scores")
    assert [player for player, _, _ in players_of(scores)] == ["cloning", CHANCE] * 2
    assert "| - |" in page_of(tmp_path / "docs", tmp_path, draw_only=True)


@pytest.mark.usefixtures("known")
def test_it_takes_no_settings_of_an_experiment(tmp_path: Path) -> None:
    with pytest.raises(PresetError, match="expected only --output, --work, --jobs, --draw-only"):
        command.reproduce("elsewhere", seeds=1, output=tmp_path)


def test_tables_of_the_catalogue_name_panels_and_worlds_that_exist() -> None:
    for table in TRANSFER_TABLES.values():
        for policies in table.policies:
            experiment = catalogue.find_experiment(policies.experiment)
            (panel,) = [it for it in experiment.panels if it.title == policies.panel]
            assert {it.name for it in panel.conditions} >= set(policies.conditions)
            preset = experiment.preset_of(panel, panel.conditions[0], 0)
            for world in table.worlds:
                with_settings(preset, world.overrides)
