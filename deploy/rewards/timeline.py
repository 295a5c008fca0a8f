"""What discriminators reward over the steps of one episode, beside its pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
import torch
from numpy.typing import NDArray

from actors.acting import Greedy
from actors.policy import Policy
from actors.rollout import collect
from actors.task import make_task_env
from broker_config.codec import decode
from broker_config.errors import StorageError
from broker_config.messages import Rewards, Trajectory, TrajectoryId
from broker_config.preset import Preset
from deploy.offline.recorded_episodes import RecordedRun, journal_entries, source_paths
from discriminator.labelling import snapshot_of
from discriminator.rewards import discriminator_reward
from discriminator.stored import StoredDiscriminators
from learner.tickets import make_ticket

mpl.use("Agg")  # before pyplot: there is no screen
from matplotlib import pyplot as plt
from matplotlib.figure import SubFigure

NAMES: Final = {"expert": "D_E", "target": "D_T"}
"""Of discriminators, in figures."""
COLOURS: Final = {"expert": "C0", "target": "C4"}
_MOST_PICTURES: Final = 10


@dataclass(frozen=True)
class Timeline:
    """An episode, and what discriminators say of each of its steps."""

    title: str
    trajectory: Trajectory
    rewards: Mapping[str, NDArray[np.float32]]
    """-log(1 - D) of the state after each step, f32[T], by discriminator."""


def score_steps(title: str, preset: Preset, weights: bytes, trajectory: Trajectory) -> Timeline:
    """What discriminators reward in an episode.

    Args:
        title: Of the timeline.
        preset: Of the run that they belong to.
        weights: Of the discriminators, as snapshots have them.
        trajectory: Of the preset's task.

    Raises:
        DecodeError: The weights are not those of the preset's discriminators.
        MessageError: The episode is of another task, or the preset imitates nothing.
    """
    snapshot = StoredDiscriminators(preset, weights)
    assert preset.imitation is not None  # or there would be no snapshot
    bound = preset.imitation.discriminator.reward_bound
    logits = snapshot.logits(torch.tensor(trajectory.observations[1:]))
    rewards = {name: discriminator_reward(it, bound).numpy() for name, it in logits.items()}
    return Timeline(title, trajectory, rewards)


def play_greedily(preset: Preset, policy: Policy) -> Trajectory:
    """The greedy policy's episode from a run's first start.

    Raises:
        PresetError: Task and preset disagree.
    """
    with closing(make_task_env(preset.task)) as env:
        id_ = TrajectoryId("in-process", "in-process", 0)
        return collect(env, Greedy(policy), make_ticket(preset, 0), id_)


def recorded_timelines(
    source: Path, episodes: Sequence[int], iteration: int | None
) -> list[Timeline]:
    """What a run's discriminators reward in episodes of the same run.

    Args:
        source: A run folder, or a recording's folder.
        episodes: Which; the first and the last if empty.
        iteration: Whose discriminators; the last ones if None.

    Raises:
        StorageError: There are no rewards of that iteration, or no such episode.
    """
    (source,) = source_paths([source])
    run = RecordedRun(source)
    given: Rewards | None = None
    for entry in journal_entries(source, "rewards"):
        rewards = decode(entry.payload, Rewards)
        if iteration in (None, rewards.iteration):
            given = rewards
    if given is None:
        wanted = "rewards" if iteration is None else f"rewards of iteration {iteration}"
        raise StorageError(
            f"{source}: expected {wanted} that discriminators gave; got none; choose another"
        )
    weights = snapshot_of(given).weights
    by = f"discriminators of iteration {given.iteration}"
    return [
        score_steps(
            f"episode {index}, {by}",
            run.preset,
            weights,
            part,
        )
        for index in (episodes or (0, run.episodes - 1))
        for part in run.parts(index)
    ]


def draw_timelines(path: Path, timelines: list[Timeline]) -> None:
    """Draws each episode's pictures, and below them its rewards step by step, as a PNG."""
    figure = plt.figure(figsize=(10, 3.4 * len(timelines)), layout="constrained")
    parts = figure.subfigures(len(timelines), 1, squeeze=False)[:, 0]
    for part, timeline in zip(parts, timelines, strict=True):
        part.suptitle(timeline.title, fontsize=10)
        _draw(part, timeline)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _draw(figure: SubFigure, timeline: Timeline) -> None:
    pictures = timeline.trajectory.observations
    steps = timeline.trajectory.steps
    shown = np.unique(np.linspace(0, steps, min(_MOST_PICTURES, steps + 1)).round().astype(int))
    grid = figure.add_gridspec(2, len(shown), height_ratios=(1, 2))
    for column, step in enumerate(shown):
        axes = figure.add_subplot(grid[0, column])
        axes.imshow(np.broadcast_to(pictures[step], (*pictures.shape[1:3], 3)))
        axes.set_title(f"{step}", fontsize=7)
        axes.axis("off")
    lower = figure.add_subplot(grid[1, :])
    at = np.arange(1, steps + 1)
    for name, rewards in timeline.rewards.items():
        lower.plot(at, rewards, ".-", color=COLOURS[name], label=f"-log(1 - {NAMES[name]})")
    lower.set(xlabel="step", ylabel="discriminators' reward", xlim=(0, steps))
    lower.grid(alpha=0.3)
    of_task = lower.twinx()
    of_task.plot(at, timeline.trajectory.rewards, "--", color="0.5", label="the task's (right)")
    of_task.set_ylabel("the task's reward")
    lines = [*lower.get_lines(), *of_task.get_lines()]
    lower.legend(handles=lines, loc="best", fontsize=7)
