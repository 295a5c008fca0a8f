"""The figures of a report, drawn from its numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, PercentFormatter
from numpy.typing import NDArray

from deploy.evaluation.scores import Mode, Score
from deploy.report.composition import RewardedIteration
from deploy.report.lives import Life
from deploy.report.record import Iteration, RunRecord
from deploy.report.running import Running, running_mean, running_rate, window_of
from deploy.report.svg import (
    BLUE,
    FAINT,
    GREEN,
    GRID,
    INK,
    ORANGE,
    PAPER,
    PURPLE,
    RED,
    Svg,
    figure_style,
    to_svg,
)
from deploy.reproduce.reward_maps import PoseGrid, best_pose_degrees

_WIDE: Final = (9.4, 3.3)
_HALF: Final = (4.6, 2.5)
_THIRD: Final = (3.4, 2.3)
_MOST_DOTS: Final = 1500
_MOST_BARS: Final = 120
_MODE_COLOURS: Final[dict[Mode, str]] = {"sampled": ORANGE, "greedy": PURPLE}
_MODE_MARKS: Final[dict[Mode, str]] = {"sampled": "s", "greedy": "D"}
DISCRIMINATOR_NAMES: Final = {"expert": "D_E", "target": "D_T"}
_PART_COLOURS: Final = {"expert": BLUE, "target": PURPLE}
_ROLE_COLOURS: Final = {
    "owner": BLUE,
    "actor": GREEN,
    "discriminator": PURPLE,
    "evaluator": ORANGE,
    "recorder": FAINT,
}


# Learning curves ------------------------------------------------------------------------------


def draw_returns(record: RunRecord) -> Svg:
    """Return of each episode, its running mean, and the evaluated policies."""
    episodes, schedule = record.episodes, record.preset.schedule
    running = running_mean(
        episodes.returns, window_of(schedule.episodes_per_iteration, len(episodes))
    )
    with figure_style("returns"):
        figure, axes = plt.subplots(figsize=_WIDE, layout="constrained")
        every = math.ceil(len(episodes) / _MOST_DOTS)
        dots = episodes.indices[::every] + 1, episodes.returns[::every]
        axes.plot(*dots, ".", color=FAINT, markersize=3.5, alpha=0.55, label="an episode")
        _draw_running(axes, record, running)
        _draw_scores(axes, record, lambda it: (it.mean_return, it.return_interval))
        axes.set(xlabel="episode", ylabel="return")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
        alt = (
            f"Return of {len(episodes)} episodes: the running mean begins at "
            f"{running.means[0]:.2f} and ends at {running.means[-1]:.2f}."
        )
        return to_svg(figure, "returns", alt)


def draw_successes(record: RunRecord) -> Svg:
    """Success rate, and that of the evaluated policies."""
    episodes, schedule = record.episodes, record.preset.schedule
    running = running_rate(
        episodes.successes, window_of(schedule.episodes_per_iteration, len(episodes))
    )
    with figure_style("successes"):
        figure, axes = plt.subplots(figsize=_THIRD, layout="constrained")
        _draw_running(axes, record, running)
        _draw_scores(axes, record, lambda it: (it.success_rate, it.success_interval))
        axes.set(xlabel="episode", ylabel="success", ylim=(-0.04, 1.04))
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        alt = (
            f"Success rate: the running mean begins at {running.means[0]:.0%} and ends at "
            f"{running.means[-1]:.0%}."
        )
        return to_svg(figure, "successes", alt)


def _draw_running(axes: Axes, record: RunRecord, running: Running) -> None:
    at = record.episodes.indices[running.ends] + 1
    label = f"mean of the last {running.window}, 95 %"
    if len(at) == 1:  # no line comes of it
        reach = [running.means - running.lows, running.highs - running.means]
        axes.errorbar(at, running.means, reach, fmt="o", color=BLUE, label=label)
    else:
        axes.fill_between(at, running.lows, running.highs, color=BLUE, alpha=0.18, linewidth=0)
        axes.plot(at, running.means, color=BLUE, linewidth=1.8, label=label)
    newest = record.episodes.indices[-1] + 1
    axes.set_xlim(-0.02 * newest, 1.02 * newest)  # the untrained policy is at 0


def _draw_scores(
    axes: Axes,
    record: RunRecord,
    value: Callable[[Score], tuple[float, tuple[float, float]]],
) -> None:
    for mode, colour in _MODE_COLOURS.items():
        # One episode has no interval.
        scores = [it for it in record.scores if it.mode == mode and it.episodes > 1]
        if not scores:
            continue
        at = [record.preset.schedule.episodes_before(it.version) for it in scores]
        means = np.array([value(it)[0] for it in scores])
        lows, highs = np.transpose([value(it)[1] for it in scores])
        axes.errorbar(
            at,
            means,
            np.maximum(0.0, [means - lows, highs - means]),
            fmt=_MODE_MARKS[mode],
            color=colour,
            markersize=3.6,
            elinewidth=1.0,
            label=f"evaluated, {mode}, 95 %",
        )


def draw_rates(iterations: Sequence[Iteration]) -> Svg:
    """Samples per second, iteration by iteration."""
    with figure_style("rates"):
        figure, axes = plt.subplots(figsize=_THIRD, layout="constrained")
        at = [it.number + 1 for it in iterations]
        rates = [it.samples / it.phases.total if it.phases.total else 0.0 for it in iterations]
        axes.plot(at, rates, color=GREEN, linewidth=1.5, marker=".", markersize=4)
        axes.set(xlabel="iteration", ylabel="samples per second", ylim=(0, None))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        alt = f"Samples per second by iteration, {min(rates):.1f} to {max(rates):.1f}."
        return to_svg(figure, "rates", alt)


def draw_lags(record: RunRecord) -> Svg:
    """Policy lag of each episode, as steps."""
    episodes = record.episodes
    changes = np.flatnonzero(np.diff(episodes.lags, prepend=-1))
    places = np.unique([*changes, len(episodes) - 1])
    with figure_style("lags"):
        figure, axes = plt.subplots(figsize=_THIRD, layout="constrained")
        at = episodes.indices[places] + 1
        axes.step(at, episodes.lags[places], where="post", color=ORANGE, linewidth=1.8)
        axes.set(xlabel="episode", ylabel="policy lag, updates")
        axes.set_ylim(-0.05, 1.05 * max(1, int(episodes.lags.max())))
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        alt = f"Policy lag of each episode, {episodes.lags.min()} to {episodes.lags.max()} updates."
        return to_svg(figure, "lags", alt)


# Rewards --------------------------------------------------------------------------------------


def draw_composition(rows: Sequence[RewardedIteration]) -> Svg:
    """Each discriminator's part of the reward, and the spread of what was learned from."""
    with figure_style("composition"):
        figure, axes = plt.subplots(figsize=_HALF, layout="constrained")
        scored = [row for row in rows if row.parts]
        words = []
        for name in scored[0].parts if scored else ():
            at = [row.iteration + 1 for row in scored]
            means = [row.parts[name] for row in scored]
            label = f"{DISCRIMINATOR_NAMES[name]}: mean of -log(1 - D)"
            axes.plot(at, means, color=_PART_COLOURS[name], linewidth=1.6, label=label)
            words.append(f"{DISCRIMINATOR_NAMES[name]} from {means[0]:.2f} to {means[-1]:.2f}")
        at = [row.iteration + 1 for row in rows]
        spreads = [row.rewards_std for row in rows]
        axes.plot(
            at, spreads, "--", color=ORANGE, linewidth=1.2, label="spread of the sum over D_G"
        )
        axes.set(xlabel="iteration", ylabel="reward", ylim=(0, None))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.legend(loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=1)
        alt = f"Mean reward of each discriminator by iteration: {', '.join(words)}."
        return to_svg(figure, "composition", alt)


def draw_discriminators(rows: Sequence[RewardedIteration]) -> Svg:
    """How often each discriminator was right, and its loss."""
    with figure_style("discriminators"):
        figure, axes = plt.subplots(figsize=_HALF, layout="constrained")
        at = [row.iteration + 1 for row in rows]
        for name, colour in _PART_COLOURS.items():
            if f"{name}_accuracy" not in rows[0].numbers:
                continue
            its = DISCRIMINATOR_NAMES[name]
            right = [row.numbers[f"{name}_accuracy"] for row in rows]
            losses = [row.numbers[f"{name}_loss"] for row in rows]
            axes.plot(at, right, color=colour, linewidth=1.6, label=f"{its}: told apart")
            axes.plot(at, losses, ":", color=colour, linewidth=1.4, label=f"{its}: loss")
        axes.axhline(0.5, color=FAINT, linewidth=0.8, linestyle=(0, (1, 2)))
        axes.set(xlabel="iteration", ylabel="portion, loss", ylim=(0, None))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.legend(loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=2)
        alt = "Accuracy and loss of each discriminator, by iteration; 0.5 is chance."
        return to_svg(figure, "discriminators", alt)


def draw_timeline(parts: Mapping[str, NDArray[np.float32]], task: NDArray[np.float32]) -> Svg:
    """What each discriminator rewards over the steps of an episode, beside the task's reward.

    Args:
        parts: -log(1 - D) of the state after each step, f32[T], by discriminator.
        task: The task's rewards, f32[T].
    """
    with figure_style("timeline"):
        figure, axes = plt.subplots(figsize=_HALF, layout="constrained")
        at = np.arange(1, len(task) + 1)
        for name, part in parts.items():
            label = f"{DISCRIMINATOR_NAMES[name]}: -log(1 - D)"
            axes.plot(at, part, ".-", color=_PART_COLOURS[name], linewidth=1.4, label=label)
        other = axes.twinx()
        other.grid(visible=False)
        other.plot(at, task, "--", color=FAINT, linewidth=1.2, label="the task's (right)")
        axes.set(xlabel="step", ylabel="reward", ylim=(0, None))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        lines = [*axes.get_lines(), *other.get_lines()]
        axes.legend(handles=lines, loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=2)
        alt = "Reward of each discriminator after each step of the episode, and the task's."
        return to_svg(figure, "timeline", alt)


def draw_reward_map(grid: PoseGrid, rewards: NDArray[np.float64]) -> Svg:
    """What both discriminators reward together over all poses of an arm with two joints."""
    with figure_style("map"):
        figure, axes = plt.subplots(figsize=_HALF, layout="constrained")
        # The first joint goes with the first axis, and is drawn to the right.
        filled = axes.contourf(grid.degrees, grid.degrees, rewards.T, levels=12, cmap="cividis")
        figure.colorbar(filled, ax=axes, label="reward")
        best, peak = best_pose_degrees(), np.unravel_index(rewards.argmax(), rewards.shape)
        at = tuple(float(grid.degrees[it]) for it in peak)
        axes.plot(*at, "o", color=RED, label="highest")
        axes.plot(*best, "x", color=RED, markersize=8, label="the task's best pose")
        axes.set(xlabel="first joint, degrees", ylabel="second joint, degrees")
        axes.legend(loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=2)
        alt = (
            f"Rewards over the angles of both joints: highest at {at[0]:.0f} and {at[1]:.0f} "
            f"degrees; the task's best pose is {best[0]:.0f} and {best[1]:.0f}."
        )
        return to_svg(figure, "map", alt)


# Time -----------------------------------------------------------------------------------------


def draw_phases(iterations: Sequence[Iteration]) -> Svg:
    """What each iteration's time went into, as stacked bars."""
    size = math.ceil(len(iterations) / _MOST_BARS)
    groups = [iterations[at : at + size] for at in range(0, len(iterations), size)]
    phases = {
        "waiting for episodes": (GREEN, [_mean(it.phases.episodes for it in g) for g in groups]),
        "waiting for rewards": (PURPLE, [_mean(it.phases.rewards for it in g) for g in groups]),
        "update": (BLUE, [_mean(it.phases.updates for it in g) for g in groups]),
        "learner away": (RED, [_mean(it.phases.away for it in g) for g in groups]),
    }
    with figure_style("phases"):
        figure, axes = plt.subplots(figsize=(9.4, 2.8), layout="constrained")
        at = np.array([g[0].number + 1 + (len(g) - 1) / 2 for g in groups])
        bottom = np.zeros(len(groups))
        for name, (colour, secs) in phases.items():
            if any(secs):
                axes.bar(at, secs, 0.8 * size, bottom, color=colour, label=name)
                bottom += secs
        axes.set(xlabel="iteration", ylabel="seconds")
        axes.grid(axis="x", visible=False)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
        alt = (
            f"Seconds of each iteration by phase; {bottom.min():.1f} to {bottom.max():.1f} in all."
        )
        return to_svg(figure, "phases", alt)


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


# Processes ------------------------------------------------------------------------------------


def draw_lives(record: RunRecord) -> Svg:
    """A bar for each life of each process, with restarts, lost attempts and orders."""
    rows = list(dict.fromkeys((life.role, life.id) for life in record.lives))
    unit_secs, unit = _unit_of(record.wall_secs)
    with figure_style("lives"):
        figure, axes = plt.subplots(
            figsize=(9.4, 0.75 + 0.3 * max(len(rows), 2)), layout="constrained"
        )

        def at(unix_secs: float) -> float:
            return (unix_secs - record.first_secs) / unit_secs

        for row, process in enumerate(rows):
            its = [life for life in record.lives if (life.role, life.id) == process]
            _draw_row(axes, row, its, at)
        _draw_events(axes, record, rows, at)
        axes.set_yticks(range(len(rows)), [_name(*row) for row in rows])
        axes.tick_params(axis="y", length=0, labelcolor=INK)
        axes.set(xlabel=f"{unit} since the run began", ylim=(len(rows) - 0.4, -0.6))
        axes.grid(axis="y", visible=False)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=4)
        words = ", ".join(f"{_name(*row)} {_lives_of(record.lives, row)}" for row in rows)
        return to_svg(figure, "lives", f"Who was alive when. Lives of each process: {words}.")


def _draw_row(axes: Axes, row: int, lives: Sequence[Life], at: Callable[[float], float]) -> None:
    for number, life in enumerate(lives):
        began, ended = at(life.began_secs), at(life.ended_secs)
        colour = _ROLE_COLOURS.get(life.role, INK)
        axes.barh(row, ended - began, 0.56, began, color=colour, alpha=0.85)
        if number:
            axes.plot(began, row, marker=">", color=INK, markersize=6, linestyle="none")


def _draw_events(
    axes: Axes,
    record: RunRecord,
    rows: Sequence[tuple[str, str]],
    at: Callable[[float], float],
) -> None:
    if len(record.lives) > len(rows):
        axes.plot([], [], ">", color=INK, markersize=6, label="started again")
    lost = [it for it in record.wrong if ("actor", it.actor) in rows]
    if lost:
        places = [rows.index(("actor", it.actor)) for it in lost]
        times = [at(it.unix_secs) for it in lost]
        axes.plot(times, places, "X", color=RED, markersize=7, markeredgecolor=PAPER, linestyle="")
        axes.plot(
            [], [], "X", color=RED, markersize=7, linestyle="", label="an attempt did not count"
        )
    for number, (began, ended) in enumerate(record.recorded.away if record.recorded else ()):
        label = None if number else "nobody recorded"
        axes.axvspan(
            at(began), at(ended), color=GRID, alpha=0.6, linewidth=0, zorder=0, label=label
        )
    for number, order in enumerate(record.orders):
        label = None if number else "an order was given"
        axes.axvline(at(order.unix_secs), color=ORANGE, linewidth=1.2, label=label)


def _name(role: str, id_: str) -> str:
    return "learner" if role == "owner" else id_


def _lives_of(lives: Sequence[Life], process: tuple[str, str]) -> int:
    return sum((life.role, life.id) == process for life in lives)


def _unit_of(span_secs: float) -> tuple[float, str]:
    for secs, name in ((86_400.0, "days"), (3600.0, "hours"), (60.0, "minutes")):
        if span_secs > 2 * secs:
            return secs, name
    return 1.0, "seconds"
