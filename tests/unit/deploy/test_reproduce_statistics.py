import math

import numpy as np
import pytest

from deploy.reproduce.statistics import (
    area_under_curve,
    bootstrap_band,
    bootstrap_interval,
    interquartile_mean,
    paired_difference,
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
