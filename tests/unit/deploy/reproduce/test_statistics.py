import math

import numpy as np
import pytest

from deploy.reproduce.statistics import (
    area_under_curve,
    bootstrap_band,
    bootstrap_interval,
    hierarchical_interval,
    interquartile_mean,
    paired_difference,
    rank_correlation,
    student_t_quantile,
)


def test_area_is_a_mean_return() -> None:
    assert area_under_curve([150, 300, 450], [-10.0, -10.0, -10.0]) == pytest.approx(-10)
    assert area_under_curve([0, 100, 400], [0.0, 2.0, 4.0]) == pytest.approx((100 + 900) / 400)
    assert area_under_curve([150], [-7.0]) == -7.0


@pytest.mark.parametrize(
    ("probability", "degrees", "quantile"),
    # Closed forms: tan(pi * (p - 1/2)) for 1, and for 2; then from printed tables.
    [
        (0.975, 1, math.tan(math.pi * 0.475)),
        (0.975, 2, 0.95 / math.sqrt(2 * 0.975 * 0.025)),
        (0.975, 4, 2.776445),
        (0.95, 9, 1.833113),
        (0.995, 30, 2.749996),
    ],
)
def test_student_t_quantiles(probability: float, degrees: int, quantile: float) -> None:
    assert student_t_quantile(probability, degrees) == pytest.approx(quantile, rel=1e-5)


def test_paired_difference_by_hand() -> None:
    difference = paired_difference([3.0, 5.0, 4.0], [1.0, 2.0, 3.0])
    assert difference.differences == (2.0, 3.0, 1.0)
    assert difference.mean == pytest.approx(2.0)
    reach = 4.302653 * 1.0 / math.sqrt(3)
    assert difference.t == pytest.approx((2 - reach, 2 + reach), rel=1e-5)
    low, high = difference.bootstrap
    assert 1.0 <= low < 2.0 < high <= 3.0
    # Of 27 draws, one has the mean 1 and 3 have 4/3: the 2.5 % point is the smallest.
    assert low == 1.0


def test_one_seed_has_no_spread() -> None:
    difference = paired_difference([3.0], [1.0])
    assert difference.bootstrap == (2.0, 2.0)
    assert difference.t is None


def test_the_pairing_takes_out_what_the_seeds_share() -> None:
    difference = paired_difference([101.0, 1.0, 51.0, 21.0], [100.0, 0.0, 50.0, 20.0])
    assert difference.bootstrap == (1.0, 1.0)
    assert difference.t == (1.0, 1.0)


def test_refuses_unpaired_seeds() -> None:
    with pytest.raises(ValueError, match="as many of both, at least 1; got 2, 1"):
        paired_difference([1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="got 0, 0"):
        paired_difference([], [])


def test_the_interquartile_mean_leaves_out_the_outer_quarters() -> None:
    values = np.array([[100.0, 1.0], [2.0, 2.0], [3.0, 3.0], [-50.0, 4.0]])
    assert interquartile_mean(values).tolist() == [2.5, 2.5]
    assert interquartile_mean(values[:3]).tolist() == [35.0, 2.0]  # too few to leave any out


def test_the_band_is_around_the_interquartile_mean() -> None:
    curves = np.random.default_rng(0).normal((0.0, 10.0, 20.0), size=(12, 3))
    low, high = bootstrap_band(curves)
    assert (low < interquartile_mean(curves)).all()
    assert (interquartile_mean(curves) < high).all()
    assert (high - low < 3.0).all()
    assert bootstrap_interval(np.array([2.0])) == (2.0, 2.0)


def test_rank_correlation_is_of_orders_alone() -> None:
    values = np.array([0.1, 5.0, 2.0, 3.0])
    assert rank_correlation(values, np.exp(values)) == pytest.approx(1.0)
    assert rank_correlation(values, -(values**3)) == pytest.approx(-1.0)
    # Without ties: 1 - 6 * sum(d**2) / (n * (n**2 - 1)), here with d = 1, 1, 1, 1.
    other = np.array([2.0, 3.0, 1.0, 4.0])
    assert rank_correlation(values, other) == pytest.approx(1 - 6 * 4 / (4 * 15))


def test_equal_values_share_a_rank() -> None:
    # Ranks 0.5, 0.5, 2 against 0, 1, 2: covariance 1.5 over sqrt(1.5 * 2).
    tied = rank_correlation(np.array([1.0, 1.0, 7.0]), np.array([1.0, 2.0, 3.0]))
    assert tied == pytest.approx(1.5 / math.sqrt(1.5 * 2.0))
    assert math.isnan(rank_correlation(np.ones(3), np.arange(3.0)))
    with pytest.raises(ValueError, match="as many values"):
        rank_correlation(np.ones(3), np.ones(2))


def test_a_hierarchical_interval_is_as_wide_as_the_seeds_are_apart() -> None:
    apart = np.repeat([[0.0], [1.0], [0.0], [1.0]], 100, axis=1)  # all trials of a seed agree
    low, high = hierarchical_interval(apart)
    assert (low, high) == (0.0, 1.0)  # as if there were four trials, not four hundred
    alike = np.tile([0.0, 1.0], (4, 50))
    low, high = hierarchical_interval(alike)
    assert 0.42 < low < 0.5 < high < 0.58
    # Trials of a single seed are still drawn anew.
    low, high = hierarchical_interval(np.array([[0.0, 1.0]]))
    assert (low, high) == (0.0, 1.0)
