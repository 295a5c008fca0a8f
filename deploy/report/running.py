"""Means of the newest episodes, with intervals: how a curve of single episodes is read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from deploy.reproduce.statistics import student_t_quantile

_MOST_POINTS: Final = 400
"""More than a figure shows."""
_LEAST_WINDOW: Final = 5
_NORMAL_QUANTILE: Final = 1.959964
"""Of 95 % in the middle."""


@dataclass(frozen=True)
class Running:
    """Means over a window that ends at each point, and their 95 % intervals."""

    window: int
    ends: NDArray[np.int64]
    """i64[points]: place of the newest value of each window."""
    means: NDArray[np.float64]
    lows: NDArray[np.float64]
    highs: NDArray[np.float64]


def window_of(episodes_per_iteration: int, n: int) -> int:
    """An iteration's worth of episodes, but five at least, as far as there are so many."""
    return min(n, max(episodes_per_iteration, _LEAST_WINDOW))


def running_mean(values: NDArray[np.float64], window: int) -> Running:
    """Mean and Student's interval, which takes the window's values for independent.

    Args:
        values: f64[n], n at least 1.
        window: 1...n. With 1 there is no interval: low and high are the value.
    """
    ends, windows = _windows(values, window)
    means = windows.mean(1)
    reach = np.zeros(len(means))
    if window > 1:
        reach = student_t_quantile(0.975, window - 1) * windows.std(1, ddof=1) / np.sqrt(window)
    return Running(window, ends, means, means - reach, means + reach)


def running_rate(successes: NDArray[np.bool_], window: int) -> Running:
    """Portion of successes and Wilson's interval, which holds near 0 and 1 as well.

    Args:
        successes: bool[n], n at least 1.
        window: 1...n.
    """
    ends, windows = _windows(successes.astype(np.float64), window)
    rates = windows.mean(1)
    lows, highs = wilson_interval(rates, window)
    return Running(window, ends, rates, lows, highs)


def wilson_interval(
    rates: NDArray[np.float64], n: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """95 % interval of a probability, of which so large a portion of n trials was seen."""
    squared = _NORMAL_QUANTILE**2
    centre = (rates + squared / (2 * n)) / (1 + squared / n)
    spread = np.sqrt(rates * (1 - rates) / n + squared / (4 * n * n))
    reach = _NORMAL_QUANTILE * spread / (1 + squared / n)
    return np.clip(centre - reach, 0.0, 1.0), np.clip(centre + reach, 0.0, 1.0)


def _windows(
    values: NDArray[np.float64], window: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Ends i64[points] and values f64[points, window], evenly spread over all there are."""
    n_points = min(_MOST_POINTS, len(values) - window + 1)
    ends = np.unique(np.linspace(window - 1, len(values) - 1, n_points).round().astype(np.int64))
    return ends, values[ends[:, np.newaxis] + np.arange(1 - window, 1)]
