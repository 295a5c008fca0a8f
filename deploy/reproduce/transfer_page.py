"""What a page says of policies in worlds that they have not learned in."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from deploy.reproduce.catalogue import find_experiment
from deploy.reproduce.experiment import KeptPolicies, TransferTable
from deploy.reproduce.statistics import hierarchical_interval
from deploy.reproduce.tables import table
from deploy.reproduce.transfer import CHANCE, SCRIPT, WorldScore


def write_transfer_page(
    path: Path, transfer: TransferTable, command: str, scores: Sequence[WorldScore]
) -> None:
    """Writes a table for each tested panel, and how it was made, as Markdown.

    Args:
        path: Of the page.
        transfer: What was tested.
        command: That made all this.
        scores: Of all tests; panels without any are named as missing.
    """
    parts = [
        f"# {transfer.title}",
        f"**Published** ({transfer.source}): {transfer.published}",
        f"Success at the end of {transfer.episodes} greedy episodes of each last policy, on seeds "
        "that no run learns from. In brackets the 95 % interval of a hierarchical bootstrap, over "
        "seeds and within each over its episodes; then successes and episodes of all seeds, and "
        "the mean return. The script and chance play the starts of the first seed.",
        *_sections(transfer, scores),
        "## How it was made",
        f"```\n{command}\n```",
        "\n".join(f"* {note}" for note in transfer.notes),
    ]
    path.write_text("\n\n".join(part for part in parts if part) + "\n")


def _sections(transfer: TransferTable, scores: Sequence[WorldScore]) -> Iterator[str]:
    for policies in transfer.policies:
        place = policies.experiment, policies.panel
        its = [it for it in scores if (it.trial.experiment, it.trial.panel) == place]
        yield f"## {policies.panel} (`{policies.experiment}`)"
        yield _table(transfer, policies, its) if its else "No policy has been left yet."


def _table(transfer: TransferTable, policies: KeptPolicies, scores: Sequence[WorldScore]) -> str:
    labels = _labels(policies)
    players = [it for it in labels if any(score.trial.player == it for score in scores)]
    rows = []
    for world in transfer.worlds:
        its = [score for score in scores if score.trial.world == world.overrides]
        cells = [
            _cell([score for score in its if score.trial.player == player])
            for player in (*players, SCRIPT, CHANCE)
        ]
        rows.append([world.label, *cells])
    header = [
        f"{labels[player]}, seeds: "
        f"{len({it.trial.seed for it in scores if it.trial.player == player})}"
        for player in players
    ]
    return table(["world", *header, SCRIPT, CHANCE], rows)


def _labels(policies: KeptPolicies) -> dict[str, str]:
    """Of the conditions, in their panel's order."""
    (panel,) = [
        it for it in find_experiment(policies.experiment).panels if it.title == policies.panel
    ]
    return {it.name: it.label for it in panel.conditions if it.name in policies.conditions}


def _cell(scores: Sequence[WorldScore]) -> str:
    if not scores:
        return "-"
    successes = np.array([score.successes for score in scores], np.float64)
    mean_return = np.mean([score.returns for score in scores])
    rest = f"{successes.sum():.0f}/{successes.size}, return {mean_return:.1f}"
    if len(successes) == 1:
        return f"{successes.mean():.0%}, {rest}"
    low, high = hierarchical_interval(successes)
    return f"{successes.mean():.0%} ({low:.0%} to {high:.0%}), {rest}"
