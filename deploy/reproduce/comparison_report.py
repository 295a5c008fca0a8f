"""The figure and the table of a comparison of methods over paired seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np

from broker_config.preset import Preset
from deploy.reproduce.comparison import FinishedRun, Method
from deploy.reproduce.paired import PairedDifference, area_under_curve, paired_difference

mpl.use("Agg")  # before pyplot: there is no screen
from matplotlib import pyplot as plt

_LABELS: dict[Method, str] = {
    "dpn": "DPN",
    "dueling-dpn": "Dueling DPN",
    "dqn": "DQN",
    "dueling-dqn": "Dueling DQN",
}
_COLOURS: dict[Method, str] = {
    "dpn": "C0",
    "dueling-dpn": "C2",
    "dqn": "C1",
    "dueling-dqn": "C3",
}


@dataclass(frozen=True)
class Comparison:
    """The runs of each method, over the same seeds in the same order; the first is the subject."""

    runs: Mapping[Method, Sequence[FinishedRun]]
    presets: Mapping[Method, Preset]
    """Of the first seed."""

    @property
    def subject(self) -> Method:
        """The method that the others are compared with."""
        return next(iter(self.runs))

    @property
    def others(self) -> list[Method]:
        """What it is compared with."""
        return [method for method in self.runs if method != self.subject]

    def areas(self, method: Method) -> list[float]:
        """Area under the greedy curve of each seed."""
        return [area_under_curve(run.samples, run.greedy_returns) for run in self.runs[method]]

    def difference(self, other: Method) -> PairedDifference:
        """The subject's areas minus the other's."""
        return paired_difference(self.areas(self.subject), self.areas(other))


def draw_figure(path: Path, comparison: Comparison) -> None:
    """Draws each seed's greedy returns and each method's median over samples, as a PNG."""
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for method, runs in comparison.runs.items():
        curves = np.array([run.greedy_returns for run in runs])
        samples = runs[0].samples
        for curve in curves:
            axes.plot(samples, curve, color=_COLOURS[method], alpha=0.25, linewidth=1)
        label = f"{_LABELS[method]}: median of {len(runs)} seeds"
        axes.plot(
            samples, np.median(curves, 0), "o-", color=_COLOURS[method], label=label, markersize=4
        )
    axes.set(xlabel="samples", ylabel="return of the greedy policy")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def write_table(path: Path, comparison: Comparison, command: str, figure_name: str) -> None:
    """Writes the areas, differences and what they were made from, as Markdown."""
    parts = [
        f"# {' against '.join(_LABELS[method] for method in comparison.runs)} on reaching",
        f"![Greedy return over samples]({figure_name})",
        _conclusion(comparison),
        _areas_table(comparison),
        _differences_table(comparison),
        "## How it was made",
        f"```\n{command}\n```",
        _settings(comparison),
    ]
    path.write_text("\n\n".join(parts) + "\n")


def _conclusion(comparison: Comparison) -> str:
    sentences = []
    for other in comparison.others:
        difference = comparison.difference(other)
        low, high = difference.bootstrap
        verdict = "above" if low > 0 else "below" if high < 0 else "not told apart from"
        sentences.append(
            f"{_LABELS[comparison.subject]}'s area under the curve is {verdict} "
            f"{_LABELS[other]}'s: the mean paired difference is {difference.mean:+.2f}, with a "
            f"95 % interval from {low:+.2f} to {high:+.2f} (bootstrap over seeds)."
        )
    return "\n".join(sentences)


def _areas_table(comparison: Comparison) -> str:
    methods = list(comparison.runs)
    seeds = [run.key.seed for run in comparison.runs[comparison.subject]]
    rows = [[str(seed)] for seed in seeds]
    for method in methods:
        runs = zip(comparison.areas(method), comparison.runs[method], strict=True)
        for row, (area, run) in zip(rows, runs, strict=True):
            row += [f"{area:.2f}", f"{run.greedy_returns[-1]:.2f}"]
    header = ["seed"]
    for method in methods:
        header += [f"{_LABELS[method]}, area", "last return"]
    means = np.array([[float(cell) for cell in row[1:]] for row in rows]).mean(0)
    return _table(header, [*rows, ["mean", *(f"{mean:.2f}" for mean in means)]])


def _differences_table(comparison: Comparison) -> str:
    header = ["difference of areas", "each seed", "mean", "95 % bootstrap", "95 % Student's t"]
    rows = []
    for other in comparison.others:
        difference = comparison.difference(other)
        rows.append(
            [
                f"{_LABELS[comparison.subject]} - {_LABELS[other]}",
                ", ".join(f"{value:+.2f}" for value in difference.differences),
                f"{difference.mean:+.2f}",
                _interval(difference.bootstrap),
                "needs two seeds" if difference.t is None else _interval(difference.t),
            ]
        )
    return _table(header, rows)


def _settings(comparison: Comparison) -> str:
    preset = comparison.presets[comparison.subject]
    schedule, optimiser = preset.schedule, preset.optimiser
    lines = [
        f"* Preset `{preset.name}` ({preset.source}): eta {preset.algorithm.eta:g}, gamma "
        f"{preset.algorithm.gamma:g}, M {schedule.episodes_per_iteration}, T "
        f"{preset.task.horizon}, E {schedule.memory_samples}, N {schedule.target_switches}, U "
        f"{schedule.epochs}, minibatches of {schedule.minibatch_size}, an update every "
        f"{schedule.update_every}, {optimiser.name} {optimiser.learning_rate:g}.",
        "* The area is the mean greedy return over the samples, by trapezia from the first "
        "update to the last. One greedy episode after each update is exact: the task is "
        "deterministic.",
        f"* The first {_followed(comparison)} of the preset's {schedule.iterations} iterations.",
        "* Seeds are paired: initial weights, minibatches and the episodes' random numbers are "
        "derived from them. All runs are shown, and each run's last policy counts, not its best.",
    ]
    for method, runs in comparison.runs.items():
        last = runs[0].points[-1]
        devices = " and ".join(sorted({run.device for run in runs}))
        lines.append(
            f"* {_LABELS[method]}: {last.samples} samples and {last.gradient_steps} gradient steps "
            f"a run, on {devices}; digest of its first preset "
            f"`{comparison.presets[method].digest}`."
        )
    return "\n".join(lines)


def _followed(comparison: Comparison) -> int:
    return len(comparison.runs[comparison.subject][0].points)


def _interval(bounds: tuple[float, float]) -> str:
    return f"{bounds[0]:+.2f} to {bounds[1]:+.2f}"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
