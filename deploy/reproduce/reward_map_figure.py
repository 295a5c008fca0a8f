"""Pictures of reward maps: the maps themselves, and how well they agree with the task's reward."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from deploy.reproduce.experiment import Condition
from deploy.reproduce.reward_maps import MapScore, PoseGrid, best_pose_degrees
from deploy.rewards.timeline import NAMES

mpl.use("Agg")  # before pyplot: there is no screen
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

_MAP_INCHES: Final = 1.3
_SCORE_INCHES: Final = (5.2, 3.2)
_STYLES: Final = {"all": "-", "expert": "--", "target": ":"}


@dataclass(frozen=True)
class RewardLine:
    """A condition's reward, or a part of it: a row of maps, a line of scores."""

    condition: Condition
    part: str
    """all, or the one of two discriminators that is looked at alone."""

    @property
    def label(self) -> str:
        """For figures and tables."""
        name = self.condition.label
        return name if self.part == "all" else f"{name}: {NAMES[self.part]} alone"

    def seeds(self, scores: Sequence[MapScore]) -> list[list[MapScore]]:
        """Its scores: of each seed, in the order of iterations."""
        found: dict[int, list[MapScore]] = {}
        for score in scores:
            if (score.condition, score.part) == (self.condition.name, self.part):
                found.setdefault(score.seed, []).append(score)
        return list(found.values())


def draw_maps(
    path: Path,
    grid: PoseGrid,
    rows: Mapping[RewardLine, Sequence[NDArray[np.float64]]],
    scores: Sequence[MapScore],
) -> None:
    """Draws each line's maps, iteration by iteration, beside the task's reward, as a PNG.

    Args:
        path: Where to write.
        grid: The poses.
        rows: Maps f64[n, n] of each iteration, all of one seed.
        scores: Of these maps.
    """
    n_columns = 1 + max(len(maps) for maps in rows.values())
    size = (_MAP_INCHES * n_columns + 0.8, _MAP_INCHES * 1.12 * len(rows) + 0.6)
    figure, cells = plt.subplots(
        len(rows), n_columns, figsize=size, layout="constrained", squeeze=False, sharex=True,
        sharey=True,
    )  # fmt: skip
    for row, (line, maps) in zip(cells, rows.items(), strict=True):
        _draw_map(row[0], grid, grid.true_rewards)
        row[0].set_ylabel(line.label.replace(": ", ":\n"), fontsize=7)
        row[0].set_title("the task's", fontsize=7)
        (of_line,) = line.seeds(scores)
        for axes, rewards, score in zip(row[1:], maps, of_line, strict=False):
            _draw_map(axes, grid, rewards)
            axes.plot(*score.peak_degrees, "o", color="k", markerfacecolor="none", markersize=6)
            axes.set_title(f"{score.iteration}: {score.rank_correlation:+.2f}", fontsize=7)
        for axes in row[1 + len(maps) :]:
            axes.axis("off")
    figure.supxlabel("first joint (degrees)", fontsize=8)
    figure.supylabel("second joint (degrees)", fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_map(axes: Axes, grid: PoseGrid, rewards: NDArray[np.float64]) -> None:
    """One map, coloured from its own lowest to its own highest value."""
    half = (grid.degrees[1] - grid.degrees[0]) / 2
    low, high = grid.degrees[0] - half, grid.degrees[-1] + half
    axes.imshow(rewards.T, origin="lower", extent=(low, high, low, high), cmap="viridis")
    axes.contour(
        grid.degrees, grid.degrees, grid.reachable.T.astype(float), levels=[0.5], colors="w",
        linewidths=0.6, linestyles="--",
    )  # fmt: skip
    axes.plot(*best_pose_degrees(), "+", color="r", markersize=7)
    axes.tick_params(labelsize=6)


def draw_scores(path: Path, lines: Sequence[RewardLine], scores: Sequence[MapScore]) -> None:
    """Draws rank correlations, and how far peaks are off, over iterations, as a PNG.

    Thick lines are means over seeds, thin ones the seeds.
    """
    measures: tuple[tuple[str, Callable[[MapScore], float]], ...] = (
        ("rank correlation with the task's reward", lambda score: score.rank_correlation),
        ("peak's distance from the best pose", lambda score: score.peak_error_degrees),
    )
    width, height = _SCORE_INCHES
    figure, row = plt.subplots(
        1, len(measures), figsize=(width * len(measures), height), layout="constrained"
    )
    for axes, (name, measure) in zip(row, measures, strict=True):
        for line in lines:
            _draw_score(axes, line, line.seeds(scores), measure)
        axes.set(xlabel="iteration", ylabel=name)
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.grid(alpha=0.3)
    labelled = row[0].get_legend_handles_labels()
    figure.legend(*labelled, fontsize=7, loc="outside right upper")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_score(
    axes: Axes,
    line: RewardLine,
    seeds: Sequence[Sequence[MapScore]],
    measure: Callable[[MapScore], float],
) -> None:
    style, colour = _STYLES[line.part], line.condition.colour
    curves = [[measure(score) for score in seed] for seed in seeds]
    at = [score.iteration for score in min(seeds, key=len)]
    for curve in curves:
        axes.plot(range(1, len(curve) + 1), curve, style, color=colour, linewidth=0.6, alpha=0.4)
    means = np.mean([curve[: len(at)] for curve in curves], axis=0)
    axes.plot(at, means, style, color=colour, label=f"{line.label} ({len(seeds)})", linewidth=1.8)
