"""The figure and the page of an experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib as mpl
import numpy as np

from deploy.presets import load_preset
from deploy.reproduce.experiment import Condition, Experiment, Measure, Panel
from deploy.reproduce.runs import CLONED, FinishedRun, RunKey
from deploy.reproduce.statistics import (
    PairedDifference,
    area_under_curve,
    bootstrap_band,
    interquartile_mean,
    paired_difference,
)
from deploy.reproduce.stored_scores import StoredScore, states_of
from deploy.reproduce.stored_states_section import stored_states_section
from deploy.reproduce.tables import (
    DIFFERENCE_HEADER,
    difference_row,
    mean_and_interval,
    table,
)

mpl.use("Agg")  # before pyplot: there is no screen
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

_AXIS_LABELS: dict[Measure, str] = {
    "greedy_returns": "return of the greedy policy",
    "greedy_successes": "success at the end",
    "relative_bellman_errors": "Bellman error / std(V)",
}
_AREA_OF: dict[Measure, str] = {
    "greedy_returns": "greedy return",
    "greedy_successes": "success of the greedy policy",
}
_PANEL_INCHES = (5.2, 3.4)
_LEAST_SEEDS = 3
"""With fewer the page says which is ahead, and draws no conclusion."""


@dataclass(frozen=True)
class PanelRuns:
    """A panel, and those of its runs that are finished."""

    panel: Panel
    runs: dict[str, list[FinishedRun]]
    """By condition, in the order of seeds."""
    measure: Measure = "greedy_returns"
    """Under which areas are taken."""
    scores: dict[str, list[StoredScore]] = field(default_factory=dict)
    """Of last policies on the panel's stored states, by condition."""

    @property
    def subject(self) -> Condition:
        """The condition that the others are compared with."""
        return self.panel.conditions[0]

    def areas(self, condition: Condition) -> dict[int, float]:
        """Area under the curve of the measure, by seed."""
        return {
            run.key.seed: area_under_curve(run.samples, getattr(run, self.measure))
            for run in self.runs[condition.name]
        }

    def difference(self, other: Condition) -> PairedDifference | None:
        """The subject's areas minus the other's, over the seeds that both have finished."""
        mine, theirs = self.areas(self.subject), self.areas(other)
        seeds = sorted(mine.keys() & theirs.keys())
        if not seeds:
            return None
        return paired_difference([mine[it] for it in seeds], [theirs[it] for it in seeds])


def sort_runs(
    experiment: Experiment, runs: Sequence[FinishedRun], scores: Sequence[StoredScore] = ()
) -> list[PanelRuns]:
    """The finished runs and their scores, by panel and condition."""
    by_key: dict[RunKey, FinishedRun] = {run.key: run for run in runs}
    sorted_runs = []
    for panel in experiment.panels:
        keys = {
            condition.name: [
                experiment.plan(panel, condition, seed).key for seed in panel.seed_numbers
            ]
            for condition in panel.conditions
        }
        found = {name: [by_key[key] for key in its if key in by_key] for name, its in keys.items()}
        scored: dict[str, list[StoredScore]] = {}
        if panel.stored_states is not None:
            digest = states_of(panel.stored_states).digest
            on_these = [score for score in scores if score.states_digest == digest]
            scored = {
                name: [score for score in on_these if score.run in its]
                for name, its in keys.items()
            }
        sorted_runs.append(PanelRuns(panel, found, experiment.measures[0], scored))
    return sorted_runs


def draw_figure(path: Path, experiment: Experiment, panels: Sequence[PanelRuns]) -> None:
    """Draws each panel's curves over samples, a row for each measure, as a PNG."""
    n_rows, n_columns = len(experiment.measures), len(panels)
    width, height = _PANEL_INCHES
    figure, grid = plt.subplots(
        n_rows,
        n_columns,
        figsize=(width * n_columns, height * n_rows),
        layout="constrained",
        squeeze=False,
        sharey="row",
    )
    for column, panel_runs in enumerate(panels):
        for row, measure in enumerate(experiment.measures):
            axes = grid[row][column]
            _draw_panel(axes, panel_runs, measure)
            axes.set(
                title=panel_runs.panel.title if row == 0 else "",
                xlabel="samples" if row == n_rows - 1 else "",
                ylabel=_AXIS_LABELS[measure] if column == 0 else "",
            )
            axes.grid(alpha=0.3)
            if row == 0:
                axes.legend(fontsize=7)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_panel(axes: Axes, panel_runs: PanelRuns, measure: Measure) -> None:
    demonstrated: list[float] = []
    for condition in panel_runs.panel.conditions:
        runs = panel_runs.runs[condition.name]
        if not runs:
            continue
        demonstrated += [
            first.training_return
            for run in runs
            if (first := run.points[0]).iteration == 0 and first.training_return is not None
        ]
        samples, curves = _curves(runs, measure)
        if not samples:
            continue  # what was cloned has no value function
        middle = interquartile_mean(curves)
        low, high = bootstrap_band(curves)
        label = f"{condition.label} ({len(runs)})"
        if condition.start in CLONED:
            axes.axhline(middle[0], color=condition.colour, linestyle=":", label=label)
            axes.axhspan(low[0], high[0], color=condition.colour, alpha=0.1)
            continue
        style = "--" if condition.start == "initialised" else "-"
        axes.plot(samples, middle, style, color=condition.colour, label=label, linewidth=1.5)
        axes.fill_between(samples, low, high, color=condition.colour, alpha=0.15, linewidth=0)
    if measure == "greedy_returns" and demonstrated:
        axes.axhline(
            float(np.mean(demonstrated)), color="purple", linestyle="-.", linewidth=1,
            label="demonstrations",
        )  # fmt: skip


def _curves(runs: Sequence[FinishedRun], measure: Measure) -> tuple[list[int], np.ndarray]:
    """Where the measure was taken, and its values f64[seeds, points]."""
    if measure == "relative_bellman_errors":
        points = [[it for it in run.points if it.iteration > 0] for run in runs]
        values = [[it.relative_bellman_error or np.nan for it in each] for each in points]
        return [it.samples for it in points[0]], np.array(values)
    curves = [getattr(run, measure) for run in runs]
    return runs[0].samples, np.array(curves, dtype=np.float64)


def write_page(
    path: Path,
    experiment: Experiment,
    panels: Sequence[PanelRuns],
    command: str,
    figure_name: str,
    sections: Sequence[str] = (),
) -> None:
    """Writes what was published, what came out, and what it was made from, as Markdown.

    Args:
        path: Of the page.
        experiment: What was compared.
        panels: Its finished runs.
        command: That made them.
        figure_name: Of the figure beside the page.
        sections: What else came out of the runs.
    """
    parts = [
        f"# {experiment.title}",
        f"![Curves over samples]({figure_name})",
        f"**Published** ({experiment.source}): {experiment.published}",
        "Lines are interquartile means over seeds, bands their 95 % bootstrap intervals; "
        "in brackets the number of seeds. Every run's last policy counts, not its best.",
    ]
    for panel_runs in panels:
        parts += [
            f"## {panel_runs.panel.title}",
            _panel_settings(panel_runs.panel),
            _conclusion(panel_runs),
            _scores_table(experiment, panel_runs),
            _differences_table(panel_runs),
            stored_states_section(panel_runs.panel, panel_runs.scores),
        ]
    parts += [
        *sections,
        "## How it was made",
        f"```\n{command}\n```",
        _settings(experiment, panels),
    ]
    path.write_text("\n\n".join(part for part in parts if part) + "\n")


def _panel_settings(panel: Panel) -> str:
    changes = ", ".join(f"`{override}`" for override in panel.overrides)
    return f"Here {changes}." if changes else ""


def _conclusion(panel_runs: PanelRuns) -> str:
    sentences = []
    for other in panel_runs.panel.conditions[1:]:
        difference = panel_runs.difference(other)
        if difference is None:
            continue
        n_seeds = len(difference.differences)
        if n_seeds < _LEAST_SEEDS:
            sentences.append(
                f"{panel_runs.subject.label}'s area under the curve minus {other.label}'s is "
                f"{difference.mean:+.2f}, which with seeds as few as {n_seeds} tells nothing yet."
            )
            continue
        low, high = difference.bootstrap
        verdict = "above" if low > 0 else "below" if high < 0 else "not told apart from"
        sentences.append(
            f"{panel_runs.subject.label}'s area under the curve is {verdict} {other.label}'s: the "
            f"mean paired difference is {difference.mean:+.2f}, with a 95 % interval from "
            f"{low:+.2f} to {high:+.2f} (bootstrap over {n_seeds} seeds)."
        )
    return "\n".join(sentences)


def _scores_table(experiment: Experiment, panel_runs: PanelRuns) -> str:
    looks_at_success = "greedy_successes" in experiment.measures
    header = ["condition", "seeds", "last return", "95 %"]
    header += ["last success", "95 %"] if looks_at_success else []
    header += ["area", "samples", "gradient steps", "minutes a run"]
    rows = []
    for condition in panel_runs.panel.conditions:
        runs = panel_runs.runs[condition.name]
        if not runs:
            continue
        cells = [condition.label, str(len(runs))]
        cells += mean_and_interval([run.greedy_returns[-1] for run in runs], "{:.2f}")
        if looks_at_success:
            cells += mean_and_interval([run.greedy_successes[-1] for run in runs], "{:.0%}")
        minutes = np.mean([sum(it.secs for it in run.points) for run in runs]) / 60
        last = runs[0].points[-1]
        cells += [
            f"{np.mean(list(panel_runs.areas(condition).values())):.2f}",
            str(last.samples),
            str(last.gradient_steps),
            f"{minutes:.1f}",
        ]
        rows.append(cells)
    return table(header, rows)


def _differences_table(panel_runs: PanelRuns) -> str:
    rows = [
        difference_row(f"{panel_runs.subject.label} - {other.label}", difference)
        for other in panel_runs.panel.conditions[1:]
        if (difference := panel_runs.difference(other)) is not None
    ]
    return table(["difference of areas", *DIFFERENCE_HEADER], rows) if rows else ""


def _settings(experiment: Experiment, panels: Sequence[PanelRuns]) -> str:
    runs = [run for each in panels for runs in each.runs.values() for run in runs]
    lines = [
        *_preset_lines(experiment, panels),
        f"* The area is the mean {_AREA_OF[experiment.measures[0]]} over the samples, by trapezia "
        "from the first point to the last. Greedy episodes after each update: "
        f"{experiment.episodes}.",
        "* Seeds are paired: initial weights, minibatches, demonstrations and the episodes' random "
        "numbers are derived from them. All runs are shown.",
        *(f"* {note}" for note in experiment.notes),
    ]
    if changes := [f"`{it}`" for it in (*experiment.overrides, *experiment.changes)]:
        lines.append(f"* Changed from the preset: {', '.join(changes)}.")
    rates = sorted({run.key.mistake_rate for run in runs if run.key.mistake_rate is not None})
    if rates:
        lines.append(
            f"* Demonstrations: the task's script, {' or '.join(f'{rate:.0%}' for rate in rates)} "
            "of its actions random, drawn anew for each seed and the same for all conditions of "
            "it; they begin where a run's first episodes do."
        )
    return "\n".join(lines)


def _preset_lines(experiment: Experiment, panels: Sequence[PanelRuns]) -> list[str]:
    """What the runs of each preset were made with."""
    by_name: dict[str, list[FinishedRun]] = {}
    for each in panels:
        its = by_name.setdefault(experiment.preset_name(each.panel), [])
        its += [run for runs in each.runs.values() for run in runs]
    lines = []
    for name, runs in by_name.items():
        preset = load_preset(name, (*experiment.overrides, *experiment.changes))
        schedule, optimiser = preset.schedule, preset.optimiser
        followed = max((run.iterations for run in runs), default=0)
        made_on = " and ".join(sorted({run.compute for run in runs}))
        lines.append(
            f"* Preset `{preset.name}` ({preset.source}), where a condition does not say "
            f"otherwise: eta {preset.algorithm.eta:g}, gamma {preset.algorithm.gamma:g}, M "
            f"{schedule.episodes_per_iteration}, T {preset.task.horizon}, E "
            f"{schedule.memory_samples}, N {schedule.target_switches}, U {schedule.epochs}, "
            f"minibatches of {schedule.minibatch_size}, an update every {schedule.update_every}, "
            f"{optimiser.name} {optimiser.learning_rate:g}; {followed} of {schedule.iterations} "
            f"iterations; {made_on}."
        )
    return lines
