"""What an experiment's last policies look at."""

from __future__ import annotations

from pathlib import Path

from actors.policy import Policy
from broker_config.errors import StorageError
from deploy.attention import AttendedStep, attend
from deploy.reproduce.catalogue import EXPERIMENTS
from deploy.reproduce.experiment import AttentionFigure
from deploy.reproduce.in_process_run import policy_file
from deploy.reproduce.runs import RunPlan
from learner.cloning import cloning_preset


def attended_rows(figure: AttentionFigure, work: Path) -> list[tuple[str, list[AttendedStep]]]:
    """The first steps of a greedy episode of each policy, under its condition's label.

    Args:
        figure: Whose policies.
        work: Folder in which experiments keep them.

    Raises:
        StorageError: A policy is not there.
    """
    experiment = EXPERIMENTS[figure.experiment]
    rows = []
    for panel in experiment.panels:
        for condition in panel.conditions:
            if condition.name in figure.conditions:
                plan = experiment.plan(panel, condition, figure.seed)
                policy = _kept_policy(work / experiment.name, plan)
                attended = attend(plan.preset, policy, episode=0, steps=figure.steps)
                rows.append((condition.label, attended))
    return rows


def _kept_policy(work: Path, plan: RunPlan) -> Policy:
    path = policy_file(work, plan)
    preset = cloning_preset(plan.preset) if plan.key.start == "cloned" else plan.preset
    try:
        return Policy.from_bytes(preset.network, path.read_bytes())
    except OSError as error:
        raise StorageError(
            f"{path}: expected the last policy of {plan.key.name}; got {error}; run its experiment "
            "first, with the same --work"
        ) from error


def write_attention_page(
    path: Path, figure: AttentionFigure, command: str, picture_name: str
) -> None:
    """Writes what was published, and how the picture was made, as Markdown."""
    path.write_text(
        f"# {figure.title}\n\n"
        f"![Pictures, and below them what speaks for the action]({picture_name})\n\n"
        f"**Published** ({figure.source}): {figure.published}\n\n"
        "Each policy's greedy episode from the run's first start. Above: the picture, the action "
        "chosen on it and its reward. Below: Grad-CAM of that action's preference on the last "
        "convolution, red where most speaks for it. Policies are the last ones of "
        f"`{figure.experiment}`, seed {figure.seed}.\n\n"
        f"```\n{command}\n```\n"
    )
