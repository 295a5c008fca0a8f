"""Winograd's transforms of pictures, compiled.

A convolution with stride 1 and r x r weights gives m x m outputs from a tile of n x n inputs,
n = m + r - 1. With the three small matrices A, B and G of the Cook-Toom algorithm it is

    Y = A' [(G g G') * (B' x B)] A

where * multiplies element by element. Over many tiles and channels each of the n * n elements is a
matrix product of its own, and there are (n / (m * r))**2 times as many multiplications as without:
16 instead of 36 for r = 2 and for r = 3. Gradients go through the transposed matrices, and save as
much.

n is 4 here throughout, from the points 0, 1, -1 and infinity, so that B is the same for m = 3,
r = 2 and for m = 2, r = 3, and that A and B only add and subtract: the error is about twice that of
the rounding before the products. A and B are applied by the loops below, along rows and then along
columns, over all channels of a tile at a time.

A stride of s is a stride of 1 over blocks of s x s inputs, if the weights' size is r * s: the
channels of a block are all those of its inputs.

What goes into the products and comes out of them is float32 or bfloat16; all else is float32.

Source: Lavin and Gray, Fast algorithms for convolutional neural networks, 2016.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from learner.steps.factors import Factors, compiled

POINTS = 4
"""n: inputs of a tile along each axis."""

_HALF, _LOW, _ONE = np.uint32(16), np.uint32(0x7FFF), np.uint32(1)
"""Of bfloat16: how many bits fewer it has, the most of them that round down, and the last kept."""
_A_HALF, _NOTHING = np.float32(0.5), np.float32(0.0)

_MOST_OUTPUTS = _MOST_WEIGHTS = 3

Floats = NDArray[np.float32]


class Tiling(NamedTuple):
    """How tiles lie on the outputs of a convolution, picture by picture, row by row."""

    size: int
    """m: rows and columns of outputs of a tile, 2 or 3."""
    outputs: tuple[int, int]
    """Rows and columns of outputs that there are; tiles reach beyond."""
    n_down: int
    n_across: int
    stride: int
    """s, of the inputs."""


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _get(numbers: Any, k: int) -> Any:
    """A number as float32."""
    # Which of the two it is, is the same for all numbers of an array: LLVM asks before its loops.
    if numbers.itemsize == 4:
        return np.float32(numbers[k])
    return np.uint32(np.uint32(numbers[k]) << _HALF).view(np.float32)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _put(numbers: Any, k: int, value: Any) -> None:
    """Keeps a number, rounded to even if it is to be bfloat16."""
    if numbers.itemsize == 4:
        numbers[k] = value
    else:
        bits = np.float32(value).view(np.uint32)
        is_odd = np.uint32(np.uint32(bits >> _HALF) & _ONE)
        numbers[k] = np.uint16(np.uint32(np.uint32(bits + _LOW) + is_odd) >> _HALF)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _to_points(x0: Any, x1: Any, x2: Any, x3: Any) -> Any:
    """B' x."""
    return x0 - x2, x1 + x2, x2 - x1, x3 - x1


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _gradients_from_points(v0: Any, v1: Any, v2: Any, v3: Any) -> Any:
    """B v."""
    return v0, v1 - v2 - v3, v1 + v2 - v0, v3


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _from_points(m0: Any, m1: Any, m2: Any, m3: Any, last: Any) -> Any:
    """A' m, three outputs; `last` is 1 if the third is one, 0 if there are two."""
    total, difference = m1 + m2, m1 - m2
    return m0 + total, difference + (np.float32(1.0) - last) * m3, total + last * m3


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _relu(x: Any) -> Any:
    """max(0, x), but NaN stays NaN."""
    return _NOTHING if x < _NOTHING else x


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _gradients_to_points(y0: Any, y1: Any, y2: Any, last: Any) -> Any:
    """A y; `y2` is 0 if there are two outputs."""
    even = y0 + y2
    return y0, even + y1, even - y1, (np.float32(1.0) - last) * y1 + last * y2


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _place(tile: int, tiling: Tiling) -> Any:
    """The picture of a tile, and the row and the column of its first output there."""
    picture, rest = divmod(tile, tiling.n_down * tiling.n_across)
    down, across = divmod(rest, tiling.n_across)
    return picture, down * tiling.size, across * tiling.size


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _weights_to_points(g0: Any, g1: Any, g2: Any, last: Any) -> Any:
    """G g, of three weights; of two if `last` is 0, and `g2` is 0 then."""
    even, odd = _A_HALF * (g0 + g2), _A_HALF * g1
    return g0, even + odd, even - odd, (np.float32(1.0) - last) * g1 + last * g2


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _weight_gradients_from_points(u0: Any, u1: Any, u2: Any, u3: Any, last: Any) -> Any:
    """G' u; the third is 0 if `last` is."""
    even, odd = _A_HALF * (u1 + u2), _A_HALF * (u1 - u2)
    return u0 + even, odd + (np.float32(1.0) - last) * u3, last * (even + u3)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def transform_weights(weights: Floats, transformed: Factors) -> None:
    """G g G' of all weights between two channels.

    Args:
        weights: f32[O, r, s, r, run], where `run` counts the channels of s pixels of a row.
        transformed: [16, O, s * run]; gets the result.
    """
    n_outputs, reach, stride, _, run = weights.shape
    passed = np.empty((_MOST_WEIGHTS, POINTS, run), np.float32)
    passed[reach:] = 0.0
    nothing, last = np.zeros(run, np.float32), np.float32(reach == _MOST_WEIGHTS)
    for output in range(n_outputs):
        for dy in range(stride):
            for p in range(reach):
                x0, x1 = weights[output, p, dy, 0], weights[output, p, dy, 1]
                x2 = weights[output, p, dy, 2] if reach == _MOST_WEIGHTS else nothing
                y0, y1, y2, y3 = passed[p, 0], passed[p, 1], passed[p, 2], passed[p, 3]
                for k in range(run):
                    y0[k], y1[k], y2[k], y3[k] = _weights_to_points(x0[k], x1[k], x2[k], last)
            at = slice(dy * run, (dy + 1) * run)
            for q in range(POINTS):
                x0, x1, x2 = passed[0, q], passed[1, q], passed[2, q]
                y0, y1 = transformed[q, output, at], transformed[4 + q, output, at]
                y2, y3 = transformed[8 + q, output, at], transformed[12 + q, output, at]
                for k in range(run):
                    v0, v1, v2, v3 = _weights_to_points(x0[k], x1[k], x2[k], last)
                    _put(y0, k, v0)
                    _put(y1, k, v1)
                    _put(y2, k, v2)
                    _put(y3, k, v3)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def transform_weight_gradients(transformed: Floats, gradients: Floats) -> None:
    """G' u G.

    Args:
        transformed: Gradients by what `transform_weights` gives, f32[16, O, s * run].
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
                    y0[k], y1[k], y2[k] = _weight_gradients_from_points(
                        x0[k], x1[k], x2[k], x3[k], last
                    )
            for p in range(reach):
                x0, x1, x2, x3 = passed[p, 0], passed[p, 1], passed[p, 2], passed[p, 3]
                y0, y1 = gradients[output, p, dy, 0], gradients[output, p, dy, 1]
                y2 = gradients[output, p, dy, 2] if reach == _MOST_WEIGHTS else beyond
                for k in range(run):
                    y0[k], y1[k], y2[k] = _weight_gradients_from_points(
                        x0[k], x1[k], x2[k], x3[k], last
                    )


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def fold_pictures(pictures: NDArray[np.uint8], n_channels: int, folded: Floats) -> None:
    """Gives each block of s x s pixels the channels of all of them, in 0...1.

    Args:
        pictures: u8[B, H, W, C].
        n_channels: s * s * C.
        folded: f32[B, h, w * s * s * C]; gets the result, where there are pixels for it.
    """
    stride = int(math.sqrt(n_channels // pictures.shape[3]))
    run = n_channels // stride
    n_rows = min(folded.shape[1], pictures.shape[1] // stride)
    n_columns = min(folded.shape[2] // n_channels, pictures.shape[2] // stride)
    scale = np.float32(1.0 / 255.0)
    lines = pictures.reshape(pictures.shape[0], pictures.shape[1], -1)
    for picture in range(len(pictures)):
        for row in range(n_rows):
            blocks = folded[picture, row]
            for dy in range(stride):
                pixels = lines[picture, stride * row + dy]
                for column in range(n_columns):
                    at = (column * stride + dy) * run
                    for k in range(run):
                        blocks[at + k] = scale * pixels[column * run + k]


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def transform_inputs(inputs: Floats, tiling: Tiling, transformed: Factors) -> None:
    """B' x B of each tile.

    Args:
        inputs: f32[B, s * h, w * run], where `run` counts the channels of s pixels of a row.
        tiling: Of the blocks of s x s pixels.
        transformed: [16, T, s * run]; gets the result.
    """
    run = transformed.shape[2] // tiling.stride
    passed = np.empty((POINTS, POINTS, run), np.float32)
    for tile in range(transformed.shape[1]):
        picture, down, across = _place(tile, tiling)
        for dy in range(tiling.stride):
            for p in range(POINTS):
                line = inputs[picture, tiling.stride * (down + p) + dy, across * run :]
                x0, x1, x2, x3 = line[:run], line[run:], line[2 * run :], line[3 * run :]
                y0, y1, y2, y3 = passed[p, 0], passed[p, 1], passed[p, 2], passed[p, 3]
                for k in range(run):
                    y0[k], y1[k], y2[k], y3[k] = _to_points(x0[k], x1[k], x2[k], x3[k])
            at = slice(dy * run, (dy + 1) * run)
            for q in range(POINTS):
                x0, x1, x2, x3 = passed[0, q], passed[1, q], passed[2, q], passed[3, q]
                y0, y1 = transformed[q, tile, at], transformed[4 + q, tile, at]
                y2, y3 = transformed[8 + q, tile, at], transformed[12 + q, tile, at]
                for k in range(run):
                    v0, v1, v2, v3 = _to_points(x0[k], x1[k], x2[k], x3[k])
                    _put(y0, k, v0)
                    _put(y1, k, v1)
                    _put(y2, k, v2)
                    _put(y3, k, v3)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def add_input_gradients(transformed: Factors, tiling: Tiling, gradients: Floats) -> None:
    """B v B' of each tile, added where tiles overlap.

    Args:
        transformed: Gradients by what `transform_inputs` gives.
        tiling: The same as there.
        gradients: Shaped like its `inputs`; overwritten.
    """
    run = transformed.shape[2] // tiling.stride
    passed = np.empty((POINTS, POINTS, run), np.float32)
    gradients[:] = 0.0
    for tile in range(transformed.shape[1]):
        picture, down, across = _place(tile, tiling)
        for dy in range(tiling.stride):
            at = slice(dy * run, (dy + 1) * run)
            for q in range(POINTS):
                x0, x1 = transformed[q, tile, at], transformed[4 + q, tile, at]
                x2, x3 = transformed[8 + q, tile, at], transformed[12 + q, tile, at]
                y0, y1, y2, y3 = passed[0, q], passed[1, q], passed[2, q], passed[3, q]
                for k in range(run):
                    y0[k], y1[k], y2[k], y3[k] = _gradients_from_points(
                        _get(x0, k), _get(x1, k), _get(x2, k), _get(x3, k)
                    )
            for p in range(POINTS):
                line = gradients[picture, tiling.stride * (down + p) + dy, across * run :]
                x0, x1, x2, x3 = passed[p, 0], passed[p, 1], passed[p, 2], passed[p, 3]
                y0, y1, y2, y3 = line[:run], line[run:], line[2 * run :], line[3 * run :]
                for k in range(run):
                    v0, v1, v2, v3 = _gradients_from_points(x0[k], x1[k], x2[k], x3[k])
                    y0[k] += v0
                    y1[k] += v1
                    y2[k] += v2
                    y3[k] += v3


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def transform_outputs(transformed: Factors, bias: Floats, tiling: Tiling, outputs: Floats) -> None:
    """max(0, A' m A + bias) of each tile.

    Args:
        transformed: [16, T, O].
        bias: f32[O].
        tiling: Of the outputs.
        outputs: f32[B, >= rows, >= columns * O]; these rows and columns get the result.
    """
    run = len(bias)
    passed = np.empty((_MOST_OUTPUTS, POINTS, run), np.float32)
    made = np.empty(_MOST_OUTPUTS * run, np.float32)
    last = np.float32(tiling.size == _MOST_OUTPUTS)
    for tile in range(transformed.shape[1]):
        picture, down, across = _place(tile, tiling)
        for q in range(POINTS):
            x0, x1 = transformed[q, tile], transformed[4 + q, tile]
            x2, x3 = transformed[8 + q, tile], transformed[12 + q, tile]
            y0, y1, y2 = passed[0, q], passed[1, q], passed[2, q]
            for k in range(run):
                y0[k], y1[k], y2[k] = _from_points(
                    _get(x0, k), _get(x1, k), _get(x2, k), _get(x3, k), last
                )
        width = min(tiling.size, tiling.outputs[1] - across) * run
        for row in range(min(tiling.size, tiling.outputs[0] - down)):
            x0, x1, x2, x3 = passed[row, 0], passed[row, 1], passed[row, 2], passed[row, 3]
            y0, y1, y2 = made[:run], made[run : 2 * run], made[2 * run :]
            for k in range(run):
                v0, v1, v2 = _from_points(x0[k], x1[k], x2[k], x3[k], last)
                y0[k] = _relu(v0 + bias[k])
                y1[k] = _relu(v1 + bias[k])
                y2[k] = _relu(v2 + bias[k])
            line = outputs[picture, down + row, across * run :]
            for k in range(width):
                line[k] = made[k]


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def transform_output_gradients(
    gradients: Floats, outputs: Floats, tiling: Tiling, transformed: Factors, bias: Floats
) -> None:
    """A y A' of each tile, after the ReLU; and the gradients of the bias.

    Args:
        gradients: By `outputs`, in their shape; what only tiles reach counts for nothing.
        outputs: What `transform_outputs` gave.
        tiling: The same as there.
        transformed: [16, T, O]; gets the result.
        bias: f32[O]; its gradients are added.
    """
    run = len(bias)
    passed = np.empty((_MOST_OUTPUTS, POINTS, run), np.float32)
    masked = np.empty(_MOST_OUTPUTS * run, np.float32)
    sums = np.zeros(_MOST_OUTPUTS * run, np.float32)
    last = np.float32(tiling.size == _MOST_OUTPUTS)
    for tile in range(transformed.shape[1]):
        picture, down, across = _place(tile, tiling)
        width = min(tiling.size, tiling.outputs[1] - across) * run
        n_rows = min(tiling.size, tiling.outputs[0] - down)
        masked[:] = 0.0
        passed[n_rows:] = 0.0
        for row in range(n_rows):
            given = gradients[picture, down + row, across * run :]
            units = outputs[picture, down + row, across * run :]
            for k in range(width):
                kept = _NOTHING if units[k] <= _NOTHING else given[k]
                masked[k] = kept
                sums[k] += kept
            x0, x1, x2 = masked[:run], masked[run : 2 * run], masked[2 * run :]
            y0, y1, y2, y3 = passed[row, 0], passed[row, 1], passed[row, 2], passed[row, 3]
            for k in range(run):
                y0[k], y1[k], y2[k], y3[k] = _gradients_to_points(x0[k], x1[k], x2[k], last)
        for q in range(POINTS):
            x0, x1, x2 = passed[0, q], passed[1, q], passed[2, q]
            y0, y1 = transformed[q, tile], transformed[4 + q, tile]
            y2, y3 = transformed[8 + q, tile], transformed[12 + q, tile]
            for k in range(run):
                v0, v1, v2, v3 = _gradients_to_points(x0[k], x1[k], x2[k], last)
                _put(y0, k, v0)
                _put(y1, k, v1)
                _put(y2, k, v2)
                _put(y3, k, v3)
    for k in range(run):
        bias[k] += sums[k] + sums[run + k] + sums[2 * run + k]


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def maps_to_features(maps: Floats, n_channels: int, features: Factors) -> None:
    """Orders each picture's units by channel, then by row and column.

    Args:
        maps: f32[B, h, w * C].
        n_channels: C.
        features: [B, C * h * w]; gets the result.
    """
    n_columns = maps.shape[2] // n_channels
    for picture in range(len(maps)):
        ordered, at = features[picture], 0
        for channel in range(n_channels):
            for row in range(maps.shape[1]):
                line = maps[picture, row]
                for column in range(n_columns):
                    _put(ordered, at + column, line[column * n_channels + channel])
                at += n_columns


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def maps_from_features(features: Factors, n_channels: int, maps: Floats) -> None:
    """Undoes `maps_to_features`."""
    n_columns = maps.shape[2] // n_channels
    for picture in range(len(maps)):
        ordered, at = features[picture], 0
        for channel in range(n_channels):
            for row in range(maps.shape[1]):
                line = maps[picture, row]
                for column in range(n_columns):
                    line[column * n_channels + channel] = _get(ordered, at + column)
                at += n_columns
