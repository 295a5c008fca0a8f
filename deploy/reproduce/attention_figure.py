"""What an experiment's last policies look at."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from deploy.attention import AttendedStep, attend
from deploy.reproduce.experiment import AttentionFigure, Experiment
from deploy.reproduce.kept_weights import kept_policy
from deploy.reproduce.runs import RunPlan
from deploy.reproduce.tables import mean_and_interval, table
from deploy.reproduce.work_folder import policy_file

AttendedRows = Sequence[tuple[str, list[AttendedStep]]]
"""Of each policy its label, and its steps."""


def attended_rows(
    figure: AttentionFigure, experiment: Experiment, work: Path, seed: int
) -> list[tuple[str, list[AttendedStep]]]:
    """The first steps of a greedy episode of each policy.

    Args:
        figure: Which policies, and how many steps.
        experiment: Whose they are.
        work: Folder in which experiments keep them.
        seed: Of the runs.

    Returns:
        Labels, by condition and, where the figure has several panels, by panel; and the steps.

    Raises:
        StorageError: A policy is not there.
    """
    rows = []
    for label, plan in _plans(figure, experiment, seed):
        policy = kept_policy(work / experiment.name, plan)
        rows.append((label, attend(plan.preset, policy, episode=0, steps=figure.steps)))
    return rows


def seeds_with_policies(figure: AttentionFigure, experiment: Experiment, work: Path) -> list[int]:
    """Seeds of which all of the figure's policies are kept."""
    return [
        seed
        for seed in sorted({seed for panel in experiment.panels for seed in panel.seed_numbers})
        if all(
            policy_file(work / experiment.name, plan).exists()
            for _, plan in _plans(figure, experiment, seed)
        )
    ]


def _plans(
    figure: AttentionFigure, experiment: Experiment, seed: int
) -> Iterator[tuple[str, RunPlan]]:
    panels = [it for it in experiment.panels if not figure.panels or it.title in figure.panels]
    for panel in panels:
        for condition in panel.conditions:
            if condition.name in figure.conditions:
                place = f"{panel.title}:\n" if len(panels) > 1 else ""
                yield f"{place}{condition.label}", experiment.plan(panel, condition, seed)


def heat_table(rows_of_seeds: Mapping[int, AttendedRows]) -> str:
    """How much of the heat lies on cloth, over seeds, as Markdown; of pictures that show cloth."""
    header = ["policy", "seeds", "heat on cloth", "95 %", "cloth in the picture", "95 %"]
    on_cloth: dict[str, list[float]] = {}
    shares: dict[str, list[float]] = {}
    for rows in rows_of_seeds.values():
        for label, steps in rows:
            looked = [step for step in steps if step.heat.any()]
            if looked:
                on_cloth.setdefault(label, []).append(
                    float(np.mean([step.heat_on_cloth for step in looked]))
                )
                shares.setdefault(label, []).append(
                    float(np.mean([step.cloth_share for step in looked]))
                )
    lines = [
        [
            label.replace("\n", " "),
            str(len(portions)),
            *mean_and_interval(portions, "{:.0%}"),
            *mean_and_interval(shares[label], "{:.0%}"),
        ]
        for label, portions in on_cloth.items()
    ]
    return table(header, lines)


def write_attention_page(
    path: Path,
    figure: AttentionFigure,
    command: str,
    picture_name: str,
    rows_of_seeds: Mapping[int, AttendedRows],
) -> None:
    """Writes what was published, what came out, and how the picture was made, as Markdown."""
    path.write_text(
        f"# {figure.title}\n\n"
        f"![Pictures, and below them what speaks for the action]({picture_name})\n\n"
        f"**Published** ({figure.source}): {figure.published}\n\n"
        "Each policy's greedy episode from the run's first start. Above: the picture, the action "
        "chosen on it and its reward. Below: Grad-CAM of that action's preference on the last "
        "convolution, red where most speaks for it. Policies are the last ones of "
        f"`{figure.experiment}`, seed {min(rows_of_seeds)}.\n\n"
        f"{heat_table(rows_of_seeds)}\n\n"
        "Heat on cloth: the portion of Grad-CAM's heat that lies on cloth, mean over the steps "
        "shown on which anything speaks for the action; by chance it is the cloth's portion of the "
        "picture.\n\n"
        f"```\n{command}\n```\n"
    )
