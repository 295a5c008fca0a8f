"""Tables of a page, as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from deploy.reproduce.statistics import PairedDifference, bootstrap_interval

ONE_SEED: Final = "needs two seeds"
"""In place of an interval."""
ALL_AGREE: Final = "all agree"
"""In place of an interval where resampling shows no spread, which proves none."""
DIFFERENCE_HEADER: Final = ("each seed", "mean", "95 % bootstrap", "95 % Student's t")
"""Of the columns of `difference_row` after the first."""


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A header and its rows."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def mean_and_interval(values: Sequence[float], form: str) -> list[str]:
    """Two cells: the mean over seeds, and its 95 % bootstrap interval."""
    if len(values) == 1:
        return [form.format(values[0]), ONE_SEED]
    low, high = bootstrap_interval(np.asarray(values))
    return [form.format(np.mean(values)), f"{form.format(low)} to {form.format(high)}"]


def difference_row(label: str, difference: PairedDifference) -> list[str]:
    """A paired difference: of each seed, its mean, and both intervals."""
    return [
        label,
        ", ".join(f"{value:+.2f}" for value in difference.differences),
        f"{difference.mean:+.2f}",
        ONE_SEED if difference.t is None else _interval(difference.bootstrap),
        ONE_SEED if difference.t is None else _interval(difference.t),
    ]


def _interval(bounds: tuple[float, float]) -> str:
    return f"{bounds[0]:+.2f} to {bounds[1]:+.2f}"
