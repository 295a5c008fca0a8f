"""Learning curves as a figure: panel by panel, with intervals."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from deploy.reproduce.experiment import Measure
from deploy.reproduce.panel_runs import PanelRuns
from deploy.reproduce.runs import CLONED, FinishedRun
from deploy.reproduce.statistics import bootstrap_band, interquartile_mean

mpl.use("Agg")  # before pyplot: there is no screen
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

_AXIS_LABELS: dict[Measure, str] = {
    "greedy_returns": "return of the greedy policy",
    "greedy_successes": "success at the end",
    "training_returns": "return while learning",
    "relative_bellman_errors": "Bellman error / std(V)",
}
_PANEL_INCHES = (5.2, 3.4)
_MOST_SIDE_BY_SIDE = 4
_TITLE_WIDTH = 48


def draw_curves(path: Path, measures: Sequence[Measure], panels: Sequence[PanelRuns]) -> None:
    """Draws each panel's curves over samples, a row for each measure, as a PNG.

    Panels of which no run is finished are left out. No more stand side by side than are legible;
    the others follow below.
    """
    shown = [it for it in panels if any(it.runs.values())] or panels[:1]
    starts = range(0, len(shown), _MOST_SIDE_BY_SIDE)
    blocks = [shown[start : start + _MOST_SIDE_BY_SIDE] for start in starts]
    n_columns, n_rows = len(blocks[0]), len(measures) * len(blocks)
    width, height = _PANEL_INCHES
    figure, grid = plt.subplots(
        n_rows,
        n_columns,
        figsize=(width * n_columns, height * n_rows),
        layout="constrained",
        squeeze=False,
        sharey="row",
    )
    for number, block in enumerate(blocks):
        first_row = number * len(measures)
        _draw_block(grid[first_row : first_row + len(measures)], measures, block)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_block(
    grid: NDArray[Any], measures: Sequence[Measure], block: Sequence[PanelRuns]
) -> None:
    """Panels side by side, on axes [measures, columns]; what is left over stays empty."""
    for axes in grid[:, len(block) :].flat:
        axes.set_axis_off()
    for row, measure in enumerate(measures):
        for column, panel_runs in enumerate(block):
            axes = grid[row, column]
            _draw_panel(axes, panel_runs, measure)
            axes.grid(alpha=0.3)
            if row == len(measures) - 1:
                axes.set_xlabel("samples")
        grid[row, 0].set_ylabel(_AXIS_LABELS[measure])
        if measure == "relative_bellman_errors":
            grid[row, 0].set_yscale("log")  # shared by the row
    for column, panel_runs in enumerate(block):
        grid[0, column].set_title(textwrap.fill(panel_runs.panel.title, _TITLE_WIDTH), fontsize=11)
        _explain(grid[:, column])


def _explain(column: NDArray[Any]) -> None:
    """A legend in the first of the axes, and in each below it of what is new there."""
    explained: set[str] = set()
    for axes in column:
        by_label = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        new = [label for label in by_label if label not in explained]
        if new:
            axes.legend([by_label[label] for label in new], new, fontsize=7)
        explained.update(new)


def _draw_panel(axes: Axes, panel_runs: PanelRuns, measure: Measure) -> None:
    demonstrated: list[float] = []
    for condition in panel_runs.panel.conditions:
        runs = panel_runs.runs[condition.name]
        if not runs:
            continue
        demonstrated += [its for run in runs if (its := run.demonstrated_return) is not None]
        samples, curves = _curves(runs, measure)
        if not samples:
            continue  # what was cloned has neither played to learn nor a value function
        middle = interquartile_mean(curves)
        low, high = bootstrap_band(curves)
        n_diverged = int((~np.isfinite(curves)).any(axis=1).sum())
        diverged = f", {n_diverged} diverged" if n_diverged else ""
        label = f"{condition.label} ({len(runs)}{diverged})"
        if condition.start in CLONED:
            axes.axhline(middle[0], color=condition.colour, linestyle=":", label=label)
            axes.axhspan(low[0], high[0], color=condition.colour, alpha=0.1)
            continue
        style = "--" if condition.start == "initialised" else "-"
        axes.plot(samples, middle, style, color=condition.colour, label=label, linewidth=1.5)
        axes.fill_between(samples, low, high, color=condition.colour, alpha=0.15, linewidth=0)
    if measure in ("greedy_returns", "training_returns") and demonstrated:
        axes.axhline(
            float(np.mean(demonstrated)), color="purple", linestyle="-.", linewidth=1,
            label="demonstrations",
        )  # fmt: skip


def _curves(runs: Sequence[FinishedRun], measure: Measure) -> tuple[list[int], np.ndarray]:
    """Where the measure was taken, and its values f64[seeds, points]."""
    curves = np.array([getattr(run, measure) for run in runs], np.float64)  # None is nan
    if measure in ("relative_bellman_errors", "training_returns"):
        return [it.samples for it in runs[0].points if it.iteration > 0], curves
    return runs[0].samples, curves
