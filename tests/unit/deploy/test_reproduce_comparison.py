import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from broker_config.errors import PresetError, StorageError
from broker_config.preset import Preset
from deploy.reproduce.comparison import (
    FinishedRun,
    RunKey,
    method_preset,
    read_runs,
    write_runs,
)
from deploy.reproduce.learning_curve import CurvePoint, InProcessRun
from deploy.reproduce.reaching_dpn_vs_dqn import CURVES, FIGURE, TABLE, Arguments, reproduce
from learner.checkpoint import CheckpointStore

torch.set_num_threads(1)  # as the runs' own processes have


def smoke(method="dpn", seed: int = 0) -> Preset:
    return method_preset("reaching-smoke", (), method, seed)


def without_time(points) -> list[CurvePoint]:
    return [replace(point, secs=0.0) for point in points]


def run_of(method, seed: int, returns: list[float]) -> FinishedRun:
    points = tuple(
        CurvePoint(
            i + 1, 20 * (i + 1), 5, (20 * (i + 1),), (value,), value, 0.1, 0.2, 0.3, 0.4, 1.5
        )
        for i, value in enumerate(returns)
    )
    return FinishedRun(RunKey(method, seed, f"digest-{method}-{seed}"), "cpu", points)


@pytest.mark.parametrize("method", ["dpn", "dqn"])
def test_an_interrupted_run_goes_on_as_if_it_had_not_been(tmp_path: Path, method) -> None:
    preset = smoke(method)
    whole = InProcessRun(preset, CheckpointStore(tmp_path / "whole"))
    list(whole.finish())
    interrupted = InProcessRun(preset, CheckpointStore(tmp_path / "parts"))
    next(interrupted.finish())
    resumed = InProcessRun(preset, CheckpointStore(tmp_path / "parts"))
    assert len(resumed.points) == 1
    assert len(list(resumed.finish())) == preset.schedule.iterations - 1
    assert without_time(resumed.points) == without_time(whole.points)


def test_a_run_that_was_followed_less_far_goes_on(tmp_path: Path) -> None:
    options = {"preset": "reaching-smoke", "seeds": 1, "methods": ("dpn",), "report": False}
    places = {"output": tmp_path / "docs", "work": tmp_path / "work"}
    (first,) = reproduce(Arguments(**options, **places, iterations=1), "command")
    (second,) = reproduce(Arguments(**options, **places), "command")
    assert (len(first.points), len(second.points)) == (1, 2)
    assert second.points[0] == first.points[0]
    (again,) = reproduce(Arguments(**options, **places, iterations=1), "command")
    assert again == first


def test_methods_get_equal_samples_and_gradient_steps(tmp_path: Path) -> None:
    budgets = set()
    for method in ("dpn", "dueling-dpn", "dqn", "dueling-dqn"):
        run = InProcessRun(smoke(method), CheckpointStore(tmp_path / method))
        last = list(run.finish())[-1]
        budgets.add((last.samples, last.gradient_steps))
    assert budgets == {(40, 20)}


def test_a_policy_lag_is_refused(tmp_path: Path) -> None:
    preset = method_preset("reaching-smoke", ("schedule.policy_lag=1",), "dpn", 0)
    with pytest.raises(ValueError, match=r"expected schedule\.policy_lag 0; got 1"):
        InProcessRun(preset, CheckpointStore(tmp_path))


def test_there_must_be_such_a_preset() -> None:
    with pytest.raises(PresetError, match="preset nothing"):
        method_preset("nothing", (), "dpn", 0)


def test_runs_survive_the_file(tmp_path: Path) -> None:
    runs = [run_of("dqn", 0, [1.0, 2.0]), run_of("dpn", 1, [3.0]), run_of("dpn", 0, [4.0])]
    path = tmp_path / "curves.jsonl"
    assert read_runs(path) == []
    write_runs(path, runs)
    assert read_runs(path) == [runs[2], runs[1], runs[0]]


def test_a_damaged_file_is_named_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "curves.jsonl"
    write_runs(path, [run_of("dpn", 0, [1.0])])
    path.write_text(path.read_text() + "{}\n")
    with pytest.raises(StorageError, match="got line 2"):
        read_runs(path)


def test_one_command_leaves_numbers_figure_and_table(tmp_path: Path) -> None:
    arguments = Arguments(
        seeds=1, preset="reaching-smoke", jobs=2, output=tmp_path / "docs", work=tmp_path / "work"
    )
    runs = reproduce(arguments, "the command")
    assert [run.key.method for run in runs] == ["dpn", "dqn"]
    rows = [json.loads(line) for line in (arguments.output / CURVES).read_text().splitlines()]
    assert len(rows) == 2 * 2
    assert (arguments.output / FIGURE).stat().st_size > 5000
    table = (arguments.output / TABLE).read_text()
    assert "the command" in table
    assert smoke("dpn").digest in table
    assert "| DPN - DQN |" in table
    assert reproduce(arguments, "the command") == runs  # nothing is run again


def test_the_report_states_the_paired_difference(tmp_path: Path) -> None:
    arguments = Arguments(
        seeds=3, preset="reaching-smoke", output=tmp_path / "docs", work=tmp_path / "work"
    )
    returns = {"dpn": [-2.0, -1.0, -3.0], "dqn": [-4.0, -5.0, -6.0]}
    made = [
        FinishedRun(
            RunKey(method, seed, smoke(method, seed).digest),
            "cpu",
            run_of(method, seed, [value, value]).points,
        )
        for method, values in returns.items()
        for seed, value in enumerate(values)
    ]
    write_runs(arguments.output / CURVES, made)
    reproduce(arguments, "the command")
    table = (arguments.output / TABLE).read_text()
    assert "DPN's area under the curve is above DQN's: the mean paired difference is +3.00" in table
    assert "| DPN - DQN | +2.00, +4.00, +3.00 | +3.00 | +2.00 to +4.00 | +0.52 to +5.48 |" in table
    assert "| mean | -2.00 | -2.00 | -5.00 | -5.00 |" in table
