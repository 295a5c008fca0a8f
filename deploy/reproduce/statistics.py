"""Statistics of seeds: middles, paired differences, and intervals around them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_BOOTSTRAP_DRAWS = 100_000
_BAND_DRAWS = 2_000
"""For each point of a curve: a figure shows no third digit."""
_HIERARCHICAL_DRAWS = 10_000
_INTEGRATION_INTERVALS = 4000


@dataclass(frozen=True)
class PairedDifference:
    """First method minus second, over seeds that both ran with."""

    differences: tuple[float, ...]
    mean: float
    bootstrap: tuple[float, float]
    """Percentile interval over resampled seeds. With five seeds it is too narrow: see `t`."""
    t: tuple[float, float] | None
    """Student's interval of the mean, for differences that are normally distributed; None for one
    seed, which says nothing of the spread."""


def area_under_curve(samples: Sequence[float], returns: Sequence[float]) -> float:
    """Mean return over the samples from the first to the last point, by trapezia.

    Dividing by the width keeps the unit of a return, so that areas are comparable with returns.

    Args:
        samples: Increasing.
        returns: As many.
    """
    if len(samples) < 2:
        return float(np.mean(returns))
    return float(np.trapezoid(returns, samples) / (samples[-1] - samples[0]))


def paired_difference(
    first: Sequence[float], second: Sequence[float], confidence: float = 0.95
) -> PairedDifference:
    """Compares two methods over the same seeds, in the same order.

    Raises:
        ValueError: The seeds are none, or not as many for both.
    """
    if len(first) != len(second) or not first:
        raise ValueError(
            f"paired seeds: expected as many of both, at least 1; got {len(first)}, {len(second)}"
        )
    differences = np.asarray(first, np.float64) - np.asarray(second, np.float64)
    return PairedDifference(
        differences=tuple(differences.tolist()),
        mean=float(differences.mean()),
        bootstrap=bootstrap_interval(differences, confidence),
        t=_t_interval(differences, confidence) if len(differences) > 1 else None,
    )


def rank_correlation(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Spearman's: the correlation of ranks, where equal values share the mean of theirs.

    Args:
        first: f64[n], at least 2.
        second: As many.

    Returns:
        From -1 to 1; nan where all values of one are equal, which have no order to agree with.

    Raises:
        ValueError: They are not as many, or fewer than 2.
    """
    if first.shape != second.shape or first.ndim != 1 or len(first) < 2:
        raise ValueError(
            f"ranks: expected two lines of as many values, at least 2; got {list(first.shape)}, "
            f"{list(second.shape)}"
        )
    ranks = np.stack([_ranks(first), _ranks(second)])
    deviations = ranks - ranks.mean(axis=1, keepdims=True)
    squares = float(np.prod((deviations**2).sum(axis=1)))
    return float(np.prod(deviations, axis=0).sum()) / math.sqrt(squares) if squares else math.nan


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """From 0, in increasing order."""
    _, kinds, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - (counts + 1) / 2)[kinds], np.float64)


def interquartile_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over the middle half of the seeds; with fewer than four, over all.

    Args:
        values: f64[seeds, ...].
    """
    cut = len(values) // 4
    ordered = np.sort(values, axis=0)
    return np.asarray(ordered[cut : len(values) - cut].mean(axis=0))


def bootstrap_interval(
    values: NDArray[np.float64], confidence: float = 0.95
) -> tuple[float, float]:
    """Percentile interval of the mean over resampled seeds; of one seed, that seed.

    Args:
        values: f64[seeds].
        confidence: Portion of the means that lie inside.
    """
    generator = np.random.default_rng(0)  # the interval is part of a document: always the same
    means = generator.choice(values, (_BOOTSTRAP_DRAWS, len(values))).mean(1)
    low, high = _quantiles(means, confidence)
    return float(low), float(high)


def hierarchical_interval(
    values: NDArray[np.float64], confidence: float = 0.95
) -> tuple[float, float]:
    """Percentile interval of the mean where seeds are drawn anew, and trials within each of them.

    Trials of one policy are no replications: what one seed learned, all of its trials share.

    Args:
        values: f64[seeds, trials].
        confidence: Portion of the means that lie inside.
    """
    n_seeds, n_trials = values.shape
    generator = np.random.default_rng(0)
    means = np.empty(_HIERARCHICAL_DRAWS)
    for draw in range(_HIERARCHICAL_DRAWS):
        seeds = generator.integers(n_seeds, size=(n_seeds, 1))
        means[draw] = values[seeds, generator.integers(n_trials, size=(n_seeds, n_trials))].mean()
    low, high = _quantiles(means, confidence)
    return float(low), float(high)


def bootstrap_band(
    curves: NDArray[np.float64], confidence: float = 0.95
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The same of the interquartile mean at each point of the curves.

    Args:
        curves: f64[seeds, points].
        confidence: Portion of the interquartile means that lie inside.

    Returns:
        Lower and upper bound, f64[points] each.
    """
    picks = np.random.default_rng(0).integers(len(curves), size=(len(curves), _BAND_DRAWS))
    middles = [interquartile_mean(column[picks]) for column in curves.T]
    low, high = _quantiles(np.array(middles).T, confidence)
    return low, high


def _quantiles(
    draws: NDArray[np.float64], confidence: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    tail = (1.0 - confidence) / 2.0
    low, high = np.quantile(draws, (tail, 1.0 - tail), axis=0)
    return low, high


def _t_interval(differences: NDArray[np.float64], confidence: float) -> tuple[float, float]:
    n = len(differences)
    standard_error = float(differences.std(ddof=1)) / math.sqrt(n)
    reach = student_t_quantile((1.0 + confidence) / 2.0, n - 1) * standard_error
    mean = float(differences.mean())
    return mean - reach, mean + reach


def student_t_quantile(probability: float, degrees: int) -> float:
    """Quantile of Student's t distribution for a probability in [0.5, 1), to about 1e-6."""
    low, high = 0.0, 1.0
    while _student_t_cdf(high, degrees) < probability:
        high *= 2.0
    for _ in range(60):
        middle = (low + high) / 2.0
        if _student_t_cdf(middle, degrees) < probability:
            low = middle
        else:
            high = middle
    return (low + high) / 2.0


def _student_t_cdf(t: float, degrees: int) -> float:
    """For t >= 0, with t = sqrt(degrees) * tan(angle): the density becomes a power of a cosine."""
    angles = np.linspace(0.0, math.atan(t / math.sqrt(degrees)), _INTEGRATION_INTERVALS + 1)
    log_scale = math.lgamma((degrees + 1) / 2) - math.lgamma(degrees / 2)
    density = math.exp(log_scale) / math.sqrt(math.pi) * np.cos(angles) ** (degrees - 1)
    return 0.5 + float(np.trapezoid(density, angles))
