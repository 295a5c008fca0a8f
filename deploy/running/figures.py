"""What a run leaves to look at: the learning curve and the last episode as a film strip."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from broker_config.messages import Trajectory

mpl.use("Agg")  # before pyplot: there is no screen
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

STRIP_COLUMNS = 8

SCORE_COLORS = ("C3", "C1")
"""Of the evaluated policies, by mode."""


@dataclass(frozen=True)
class ScoredPolicies:
    """What evaluation says of a run's policies in one mode, for the learning curve."""

    mode: str
    episodes: Sequence[int]
    """That each policy had learned from."""
    returns: Sequence[float]
    """Means."""
    return_intervals: Sequence[tuple[float, float]]
    success_rates: Sequence[float]
    success_intervals: Sequence[tuple[float, float]]


def draw_learning_curve(
    path: Path,
    title: str,
    returns: Sequence[float],
    successes: Sequence[bool],
    samples_per_episode: int,
    episodes_per_iteration: int,
    scored: Sequence[ScoredPolicies] = (),
) -> None:
    """Draws the return of each episode, each iteration's mean and its success rate as a PNG.

    Args:
        path: Where to write.
        title: Above the figure.
        returns: Of each episode, in ticket order.
        successes: Of each episode.
        samples_per_episode: T, for the horizontal axis.
        episodes_per_iteration: M.
        scored: Evaluated policies, drawn with their intervals.
    """
    samples = np.arange(1, len(returns) + 1) * samples_per_episode
    figure, (upper, lower) = plt.subplots(
        2, 1, figsize=(7, 5), sharex=True, height_ratios=(3, 1), layout="constrained"
    )
    upper.plot(samples, returns, ".", color="0.6", label="episode")
    ends, means = _iteration_means(np.asarray(returns), episodes_per_iteration)
    upper.plot(ends * samples_per_episode, means, "o-", color="C0", label="mean of the iteration")
    _, rates = _iteration_means(np.asarray(successes, float), episodes_per_iteration)
    lower.plot(ends * samples_per_episode, rates, "o-", color="C2")
    for color, policies in zip(SCORE_COLORS, scored, strict=False):
        at = np.asarray(policies.episodes) * samples_per_episode
        label = f"evaluated, {policies.mode}, 95 %"
        _draw_means(upper, at, policies.returns, policies.return_intervals, color, label)
        _draw_means(lower, at, policies.success_rates, policies.success_intervals, color, label)
    upper.set(ylabel="return", title=title)
    upper.legend(loc="best")
    lower.set(xlabel="samples", ylabel="success rate", ylim=(-0.05, 1.05))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_means(
    axis: Axes,
    at: NDArray[np.int64],
    means: Sequence[float],
    intervals: Sequence[tuple[float, float]],
    color: str,
    label: str,
) -> None:
    if not means:
        return
    lows, highs = np.transpose(intervals)
    arms = np.maximum(0.0, [np.asarray(means) - lows, highs - np.asarray(means)])
    axis.errorbar(at, means, arms, fmt="s", color=color, capsize=3, label=label)


def _iteration_means(
    values: NDArray[np.float64], per_iteration: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Episode counts at the iterations' ends, and the means; an unfinished iteration counts too."""
    starts = np.arange(0, len(values), per_iteration)
    ends = np.minimum(starts + per_iteration, len(values))
    means = [float(values[a:b].mean()) for a, b in zip(starts, ends, strict=True)]
    return ends, np.array(means)


def draw_film_strip(path: Path, title: str, trajectory: Trajectory) -> None:
    """Draws every picture of an episode as a PNG, with the action before it and its reward."""
    pictures = trajectory.observations
    rows = math.ceil(len(pictures) / STRIP_COLUMNS)
    figure, axes = plt.subplots(
        rows, STRIP_COLUMNS, figsize=(1.5 * STRIP_COLUMNS, 1.75 * rows), layout="constrained"
    )
    for index, axis in enumerate(np.ravel(axes)):
        axis.axis("off")
        if index >= len(pictures):
            continue
        picture = pictures[index]
        axis.imshow(picture[..., 0] if picture.shape[2] == 1 else picture, cmap="gray", vmin=0)
        axis.set_title(_caption(trajectory, index), fontsize=8)
    figure.suptitle(title)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _caption(trajectory: Trajectory, index: int) -> str:
    if index == 0:
        return "start"
    action, reward = trajectory.actions[index - 1], trajectory.rewards[index - 1]
    return f"{index}: action {action}, {reward:.2f}"
