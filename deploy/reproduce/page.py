"""The page of an experiment: what was published, what came out, and how it was made."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from broker_config.preset import TaskPreset
from deploy.presets import load_preset
from deploy.reproduce.demonstrated_section import demonstrated_returns, who_demonstrated
from deploy.reproduce.experiment import Condition, Experiment, Measure, Panel
from deploy.reproduce.panel_runs import PanelRuns
from deploy.reproduce.runs import CLONED, FinishedRun
from deploy.reproduce.statistics import PairedDifference
from deploy.reproduce.stored_states_section import stored_states_section
from deploy.reproduce.tables import (
    DIFFERENCE_HEADER,
    difference_row,
    mean_and_interval,
    table,
)

_AREA_OF: dict[Measure, str] = {
    "greedy_returns": "greedy return",
    "greedy_successes": "success of the greedy policy",
}
_LEAST_SEEDS = 3
"""With fewer the page says which is ahead, and draws no conclusion."""


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
        parts += [f"## {panel_runs.panel.title}"]
        if not any(panel_runs.runs.values()):
            parts += ["None of its runs is finished yet."]
            continue
        parts += [
            _panel_settings(panel_runs.panel),
            demonstrated_returns(panel_runs, _task_of(experiment, panel_runs.panel)),
            *_comparison(experiment, panel_runs),
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


def _task_of(experiment: Experiment, panel: Panel) -> TaskPreset:
    return experiment.preset_of(panel, panel.conditions[0], panel.first_seed).task


def _comparison(experiment: Experiment, panel_runs: PanelRuns) -> list[str]:
    scores = _scores_table(experiment, panel_runs)
    if panel_runs.panel.tries_settings:
        return [_choice(panel_runs), scores]
    differences = _differences_table(experiment, panel_runs)
    return [_conclusion(experiment, panel_runs), scores, differences]


def _choice(panel_runs: PanelRuns) -> str:
    best = panel_runs.best()
    if best is None:
        return "Nothing is chosen before all runs are finished."
    return f"Chosen, since its mean area is the largest: **{best.label}**."


def _conclusion(experiment: Experiment, panel_runs: PanelRuns) -> str:
    return "\n".join(
        _verdict(panel_runs.subject, each) for each in _differences(experiment, panel_runs)
    )


class _Difference(NamedTuple):
    """The subject minus another condition."""

    other: Condition
    of_one: str
    """What is compared: "area"."""
    of_all: str
    """The same of many: "areas"."""
    paired: PairedDifference


def _differences(experiment: Experiment, panel_runs: PanelRuns) -> Iterator[_Difference]:
    others = panel_runs.panel.conditions[1:]
    for other in others:
        if (paired := panel_runs.difference(other)) is not None:
            if other.start in CLONED:
                yield _Difference(other, "last policy", "last policies", paired)
            else:
                yield _Difference(other, "area under the curve", "areas", paired)
    if "training_returns" in experiment.measures:
        for other in others:
            if (paired := panel_runs.training_difference(other)) is not None:
                of_both = "return while learning"
                yield _Difference(other, f"mean {of_both}", of_both, paired)


def _verdict(subject: Condition, difference: _Difference) -> str:
    paired, other, what = difference.paired, difference.other, difference.of_one
    n_seeds = len(paired.differences)
    if n_seeds < _LEAST_SEEDS or paired.t is None:
        return (
            f"{subject.label}'s {what} minus {other.label}'s is {paired.mean:+.2f}, which with "
            f"seeds as few as {n_seeds} tells nothing yet."
        )
    low, high = paired.t
    verdict = "above" if low > 0 else "below" if high < 0 else "not told apart from"
    return (
        f"{subject.label}'s {what} is {verdict} {other.label}'s: the mean paired difference is "
        f"{paired.mean:+.2f}, with a 95 % interval from {low:+.2f} to {high:+.2f} "
        f"(Student's t, {n_seeds} seeds)."
    )


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
        # Of each iteration the median over runs: what stood still for a while counts for little.
        secs = np.median([[point.secs for point in run.points] for run in runs], axis=0)
        last = runs[0].points[-1]
        cells += [
            "" if condition.start in CLONED else f"{panel_runs.mean_area(condition):.2f}",
            str(last.samples),
            str(last.gradient_steps),
            f"{secs.sum() / 60:.1f}",
        ]
        rows.append(cells)
    return table(header, rows)


def _differences_table(experiment: Experiment, panel_runs: PanelRuns) -> str:
    subject = panel_runs.subject.label
    rows = [
        difference_row(f"{subject} - {it.other.label}, {it.of_all}", it.paired)
        for it in _differences(experiment, panel_runs)
    ]
    for condition in panel_runs.panel.conditions:
        if (difference := panel_runs.above_demonstrations(condition)) is not None:
            label = f"{condition.label} - its demonstrations, last return"
            rows.append(difference_row(label, difference))
    return table(["difference", *DIFFERENCE_HEADER], rows) if rows else ""


def _settings(experiment: Experiment, panels: Sequence[PanelRuns]) -> str:
    lines = [
        *_preset_lines(experiment, panels),
        f"* The area is the mean {_AREA_OF[experiment.measures[0]]} over the samples, by trapezia "
        f"from the first point to the last. Greedy episodes after each {experiment.scored_after}: "
        f"{experiment.episodes}.",
        "* Seeds are paired: initial weights, minibatches, demonstrations and the episodes' random "
        "numbers are derived from them. All runs are shown.",
        *(f"* {note}" for note in experiment.notes),
    ]
    if "training_returns" in experiment.measures:
        lines.append(
            "* The return while learning is that of the episodes that a method plays to learn from "
            "them, sampled from its policy, or epsilon-greedy; its mean is over all of them."
        )
    if changes := [f"`{it}`" for it in (*experiment.overrides, *experiment.changes)]:
        lines.append(f"* Changed from the preset: {', '.join(changes)}.")
    return "\n".join([*lines, *who_demonstrated(panels)])


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
