"""Winograd's transforms of a convolution's weights, compiled; see `winograd_pictures`."""

from __future__ import annotations

from typing import Any

import numpy as np

from learner.steps.factors import Factors, Floats
from learner.steps.vectors import LANES, compiled, load, store
from learner.steps.winograd_pictures import POINTS

_ONE, _A_HALF = np.float32(1.0), np.float32(0.5)
_MOST_WEIGHTS = 3
"""r, at most."""


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def weights_to_points(weights: Floats, transformed: Factors) -> None:
    """G g G' of all weights between two channels.

    Args:
        weights: f32[O, r, s, r, run], where `run` counts the channels of s pixels of a row.
        transformed: [16, O, s * run]; gets the result.
    """
    n_outputs, reach, stride, _, run = weights.shape
    passed = np.empty((_MOST_WEIGHTS, POINTS, run), np.float32)
    passed[reach:] = 0.0
    nothing, last = np.zeros(run, np.float32), np.float32(reach == _MOST_WEIGHTS)
    made = np.empty((POINTS * POINTS, stride, run), np.float32)
    for output in range(n_outputs):
        for dy in range(stride):
            for p in range(reach):
                x0, x1 = weights[output, p, dy, 0], weights[output, p, dy, 1]
                x2 = weights[output, p, dy, 2] if reach == _MOST_WEIGHTS else nothing
                y0, y1, y2, y3 = passed[p, 0], passed[p, 1], passed[p, 2], passed[p, 3]
                for k in range(run):
                    y0[k], y1[k], y2[k], y3[k] = _to_points(x0[k], x1[k], x2[k], last)
            for q in range(POINTS):
                x0, x1, x2 = passed[0, q], passed[1, q], passed[2, q]
                y0, y1, y2, y3 = made[q, dy], made[4 + q, dy], made[8 + q, dy], made[12 + q, dy]
                for k in range(run):
                    y0[k], y1[k], y2[k], y3[k] = _to_points(x0[k], x1[k], x2[k], last)
        for point in range(POINTS * POINTS):
            read, write = made[point].reshape(-1), transformed[point, output]
            for k in range(0, len(read), LANES):
                store(write, k, load(read, k))


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def weight_gradients_from_points(transformed: Floats, gradients: Floats) -> None:
    """G' u G.

    Args:
        transformed: Gradients by what `weights_to_points` gives, f32[16, O, s * run].
        gradients: Shaped like its `weights`; overwritten.
    """
    n_outputs, reach, stride, _, run = gradients.shape
    passed = np.empty((_MOST_WEIGHTS, POINTS, run), np.float32)
    beyond, last = np.empty(run, np.float32), np.float32(reach == _MOST_WEIGHTS)
    for output in range(n_outputs):
        for dy in range(stride):
            at = slice(dy * run, (dy + 1) * run)
            for q in range(POINTS):
                x0, x1 = transformed[q, output, at], transformed[4 + q, output, at]
                x2, x3 = transformed[8 + q, output, at], transformed[12 + q, output, at]
                y0, y1, y2 = passed[0, q], passed[1, q], passed[2, q]
                for k in range(run):
                    y0[k], y1[k], y2[k] = _from_points(x0[k], x1[k], x2[k], x3[k], last)
            for p in range(reach):
                x0, x1, x2, x3 = passed[p, 0], passed[p, 1], passed[p, 2], passed[p, 3]
                y0, y1 = gradients[output, p, dy, 0], gradients[output, p, dy, 1]
                y2 = gradients[output, p, dy, 2] if reach == _MOST_WEIGHTS else beyond
                for k in range(run):
                    y0[k], y1[k], y2[k] = _from_points(x0[k], x1[k], x2[k], x3[k], last)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _to_points(g0: Any, g1: Any, g2: Any, last: Any) -> Any:
    """G g, of three weights; of two if `last` is 0, and `g2` is 0 then."""
    even, odd = _A_HALF * (g0 + g2), _A_HALF * g1
    return g0, even + odd, even - odd, (_ONE - last) * g1 + last * g2


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _from_points(u0: Any, u1: Any, u2: Any, u3: Any, last: Any) -> Any:
    """G' u; the third is 0 if `last` is."""
    even, odd = _A_HALF * (u1 + u2), _A_HALF * (u1 - u2)
    return u0 + even, odd + (_ONE - last) * u3, last * (even + u3)
