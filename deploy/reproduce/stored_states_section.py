"""What a page says of last policies on stored initial states: tables 4.3 and 4.5."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from deploy.reproduce.experiment import Condition, Panel
from deploy.reproduce.statistics import hierarchical_interval, paired_difference
from deploy.reproduce.stored_scores import StoredScore, successes_of
from deploy.reproduce.tables import ALL_AGREE, DIFFERENCE_HEADER, ONE_SEED, difference_row, table


def stored_states_section(panel: Panel, scores: Mapping[str, Sequence[StoredScore]]) -> str:
    """Success from each stored state, and the first condition's minus the others', as Markdown.

    Args:
        panel: Whose conditions were scored.
        scores: By condition, all on the panel's states; nothing is written where there are none.
    """
    scored = {it: its for it in panel.conditions if (its := scores.get(it.name))}
    if not scored:
        return ""
    parts = [
        f"Success of the last policies, greedy, from the stored states `{panel.stored_states}`. In "
        "brackets the 95 % interval of a hierarchical bootstrap, over seeds and within each over "
        "its trials; then successes and trials of all seeds.",
        _success_table(scored),
        _differences_table(panel.conditions[0], scored),
    ]
    return "\n\n".join(part for part in parts if part)


def _success_table(scored: Mapping[Condition, Sequence[StoredScore]]) -> str:
    names = dict.fromkeys(score.initial_state for its in scored.values() for score in its)
    rows = [
        [name or "all", *(_cell(successes_of(its, name)) for its in scored.values())]
        for name in (*names, None)
    ]
    return table(["initial state", *(condition.label for condition in scored)], rows)


def _cell(successes: NDArray[np.float64]) -> str:
    low, high = hierarchical_interval(successes)
    spread = f"{low:.0%} to {high:.0%}" if len(successes) > 1 else ONE_SEED
    if len(successes) > 1 and low == high:
        spread = ALL_AGREE
    return f"{successes.mean():.0%} ({spread}), {successes.sum():.0f}/{successes.size}"


def _differences_table(
    subject: Condition, scored: Mapping[Condition, Sequence[StoredScore]]
) -> str:
    portions = {condition: _portions(its) for condition, its in scored.items()}
    mine = portions.get(subject, {})
    rows = []
    for other, theirs in portions.items():
        seeds = sorted(mine.keys() & theirs.keys())
        if other is not subject and seeds:
            difference = paired_difference([mine[it] for it in seeds], [theirs[it] for it in seeds])
            rows.append(difference_row(f"{subject.label} - {other.label}", difference))
    return table(["difference of success", *DIFFERENCE_HEADER], rows) if rows else ""


def _portions(scores: Sequence[StoredScore]) -> dict[int, float]:
    """Success from all states, by seed."""
    by_seed: dict[int, list[StoredScore]] = {}
    for score in scores:
        by_seed.setdefault(score.run.seed, []).append(score)
    return {seed: float(successes_of(its).mean()) for seed, its in by_seed.items()}
