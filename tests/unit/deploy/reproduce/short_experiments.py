"""Short experiments, and what tests of several files do with them."""

from __future__ import annotations

from dataclasses import replace

from deploy.reproduce.chapter3 import DPN, DQN, DUELING_DPN, SUPERVISED
from deploy.reproduce.chapter4 import (
    BID,
    CLONING,
    QGAIL,
)
from deploy.reproduce.experiment import Condition, Experiment, Panel
from deploy.reproduce.runs import (
    CurvePoint,
    FinishedRun,
    RunPlan,
)

INITIALISED = replace(DUELING_DPN, name="dueling-dpn-init", start="initialised")


SMOKE = Experiment(
    name="smoke",
    title="A short experiment",
    source="figure 0",
    published="It works.",
    preset="reaching-smoke",
    panels=(Panel("2 joints", (DPN, DQN, INITIALISED, SUPERVISED), seeds=2),),
    overrides=("initialisation.demonstration_samples=15", "initialisation.target_switches=2"),
    measures=("greedy_returns", "greedy_successes", "relative_bellman_errors"),
    mistake_rate=0.25,
)


IMITATION = Experiment(
    name="imitation",
    title="A short imitation",
    source="figure 0",
    published="It imitates.",
    preset="reaching-ch4-horizon30",
    panels=(Panel("2 joints", (BID, QGAIL, CLONING), seeds=1, mistake_rate=0.1),),
    overrides=(
        "task.options.n_joints=2",
        "task.n_actions=10",
        "schedule.iterations=2",
        "schedule.episodes_per_iteration=2",
        "schedule.target_switches=2",
        "imitation.demonstration_samples=40",
        "imitation.discriminator.minibatch_size=16",
        "imitation.generator_epochs=2",
        "schedule.epochs=1",
        "imitation.target_reward=-0.5",
    ),
)


def smoke_plan(condition: Condition = DPN, seed: int = 0) -> RunPlan:
    return SMOKE.plan(SMOKE.panels[0], condition, seed)


def without_time(points: list[CurvePoint]) -> list[CurvePoint]:
    return [replace(point, secs=0.0) for point in points]


def run_of(condition: Condition, seed: int, returns: list[float]) -> FinishedRun:
    points = tuple(
        CurvePoint(i, 20 * i, 5, (20 * i,), (value,), (0.5,), value, 0.1, 0.2, 0.3, 0.4, 1.5)
        for i, value in enumerate(returns)
    )
    return FinishedRun(smoke_plan(condition, seed).key, "reference steps on cpu", points)
