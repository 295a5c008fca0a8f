"""Vectors in compiled loops, against numpy and torch."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from learner.steps.factors import as_array
from learner.steps.vectors import (
    LANES,
    load,
    spread,
    store,
    zero_if_negative,
    zero_if_not_positive,
)

N = 4 * LANES


@numba.njit  # type: ignore[untyped-decorator]
def _copy(numbers: Any, copies: Any) -> None:
    for k in range(0, len(numbers), LANES):
        store(copies, k, load(numbers, k))


@numba.njit  # type: ignore[untyped-decorator]
def _calculate(x: Any, y: Any, sums: Any, differences: Any, products: Any) -> None:
    for k in range(0, len(x), LANES):
        u, v = load(x, k), load(y, k)
        store(sums, k, u + v)
        store(differences, k, u - v)
        store(products, k, u * v + spread(np.float32(0.5)))


@numba.njit  # type: ignore[untyped-decorator]
def _choose(x: Any, y: Any, unless_negative: Any, if_positive: Any) -> None:
    for k in range(0, len(x), LANES):
        store(unless_negative, k, zero_if_negative(load(x, k), load(y, k)))
        store(if_positive, k, zero_if_not_positive(load(x, k), load(y, k)))


def numbers(seed: int) -> NDArray[np.float32]:
    return np.random.default_rng(seed).normal(size=N).astype(np.float32)


def test_each_number_goes_its_own_way() -> None:
    x, y = numbers(0), numbers(1)
    made = [np.empty_like(x) for _ in range(3)]
    _calculate(x, y, *made)
    for got, expected in zip(made, (x + y, x - y, x * y + np.float32(0.5)), strict=True):
        np.testing.assert_array_equal(got, expected)


def test_what_is_chosen_by_a_sign() -> None:
    x, y = numbers(0), numbers(1)
    x[:4] = 0.0, -0.0, np.nan, np.inf
    unless_negative, if_positive = np.empty_like(x), np.empty_like(x)
    _choose(x, y, unless_negative, if_positive)
    np.testing.assert_array_equal(unless_negative, np.where(x < 0, 0, y))
    np.testing.assert_array_equal(if_positive, np.where(x <= 0, 0, y))


def test_numbers_round_to_bfloat16_as_torch_does() -> None:
    x = torch.from_numpy(numbers(0))
    # Halfway between two, of which once the lower and once the upper is even; and special ones.
    x[:6] = torch.tensor([1 + 2**-8, 1 + 3 * 2**-8, -(1 + 2**-8), torch.inf, torch.nan, 3e38])
    rounded = torch.empty(N, dtype=torch.bfloat16)
    _copy(x.numpy(), as_array(rounded))
    torch.testing.assert_close(rounded, x.to(torch.bfloat16), rtol=0, atol=0, equal_nan=True)


def test_bfloat16_widens_without_a_change() -> None:
    rounded = torch.from_numpy(numbers(0)).to(torch.bfloat16)
    widened = np.empty(N, np.float32)
    _copy(as_array(rounded), widened)
    np.testing.assert_array_equal(widened, rounded.float().numpy())


def test_a_vector_may_begin_anywhere() -> None:
    x = np.arange(N + 1, dtype=np.float32)
    shifted = np.empty(N, np.float32)
    _copy(x[1:], shifted)
    np.testing.assert_array_equal(shifted, x[1:])


def test_other_numbers_are_refused() -> None:
    with pytest.raises(numba.TypingError, match="float32 or uint16"):
        _copy(np.zeros(N), np.zeros(N))
