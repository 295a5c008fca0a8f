"""Winograd's transforms of pictures, compiled.

A convolution with stride 1 and r x r weights gives m x m outputs from a tile of n x n inputs,
n = m + r - 1. With the three small matrices A, B and G of the Cook-Toom algorithm it is

    Y = A' [(G g G') * (B' x B)] A

where * multiplies element by element. Over many tiles and channels each of the n * n elements is a
matrix product of its own, and there are (n / (m * r))**2 times as many multiplications as without:
36 instead of 100 for r = 2, 36 instead of 144 for r = 3. Gradients go through the transposed
matrices, and save as much.

n is 6 here throughout, from the points 0, 1, -1, 2, -2 and infinity, so that B is the same for
m = 5, r = 2 and for m = 4, r = 3. A and B are applied by the loops below, along rows and then along
columns, over all channels of a tile at a time.

A stride of s is a stride of 1 over blocks of s x s inputs, if the weights' size is r * s: the
channels of a block are all those of its inputs.

Source: Lavin and Gray, Fast algorithms for convolutional neural networks, 2016.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.compiled import compiler

POINTS = 6
"""n: inputs of a tile along each axis."""

# Without Python's lock, so that the learner's other threads need not wait.
_compiled: Any = compiler(nogil=True, error_model="numpy", fastmath={"contract"})

_TWO, _FOUR, _FIVE = np.float32(2.0), np.float32(4.0), np.float32(5.0)
_EIGHT, _SIXTEEN = np.float32(8.0), np.float32(16.0)

_MOST_OUTPUTS = 5

Floats = NDArray[np.float32]


class Tiling(NamedTuple):
    """How tiles lie on the outputs of a convolution, picture by picture, row by row."""

    size: int
    """m: rows and columns of outputs of a tile, 4 or 5."""
    n_down: int
    n_across: int
    stride: int
    """s, of the inputs."""


def weight_transform(size: int) -> Floats:
    """G (x) G, f32[36, r * r], which takes the weights between two channels to all elements.

    Args:
        size: r, 2 or 3.
    """
    at_points = [
        [scale * point**power for power in range(size)]
        for point, scale in (
            (0.0, 1 / 4),
            (1.0, -1 / 6),
            (-1.0, -1 / 6),
            (2.0, 1 / 24),
            (-2.0, 1 / 24),
        )
    ]
    at_infinity = [0.0] * (size - 1) + [1.0]
    matrix = np.array([*at_points, at_infinity])
    return np.kron(matrix, matrix).astype(np.float32)


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _to_points(x0: Any, x1: Any, x2: Any, x3: Any, x4: Any, x5: Any) -> Any:
    """B' x."""
    even_1, odd_1 = x4 - _FOUR * x2, x3 - _FOUR * x1
    even_2, odd_2 = x4 - x2, _TWO * (x3 - x1)
    return (
        _FOUR * x0 - _FIVE * x2 + x4,
        even_1 + odd_1,
        even_1 - odd_1,
        even_2 + odd_2,
        even_2 - odd_2,
        _FOUR * x1 - _FIVE * x3 + x5,
    )


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _gradients_from_points(v0: Any, v1: Any, v2: Any, v3: Any, v4: Any, v5: Any) -> Any:
    """B v."""
    sum_1, sum_2 = v1 + v2, v3 + v4
    difference_1, difference_2 = v1 - v2, _TWO * (v3 - v4)
    return (
        _FOUR * v0,
        _FOUR * (v5 - difference_1) - difference_2,
        -_FIVE * v0 - _FOUR * sum_1 - sum_2,
        difference_1 + difference_2 - _FIVE * v5,
        v0 + sum_1 + sum_2,
        v5,
    )


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _from_points(m0: Any, m1: Any, m2: Any, m3: Any, m4: Any, m5: Any, last: Any) -> Any:
    """A' m, five outputs; `last` is 1 if the fifth is one, 0 if there are four."""
    sum_1, sum_2 = m1 + m2, m3 + m4
    difference_1, difference_2 = m1 - m2, m3 - m4
    return (
        m0 + sum_1 + sum_2,
        difference_1 + _TWO * difference_2,
        sum_1 + _FOUR * sum_2,
        difference_1 + _EIGHT * difference_2 + (np.float32(1.0) - last) * m5,
        sum_1 + _SIXTEEN * sum_2 + last * m5,
    )


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _gradients_to_points(y0: Any, y1: Any, y2: Any, y3: Any, y4: Any, last: Any) -> Any:
    """A y; `y4` is 0 if there are four outputs."""
    even_1, odd_1 = y0 + y2 + y4, y1 + y3
    even_2 = y0 + _FOUR * y2 + _SIXTEEN * y4
    odd_2 = _TWO * y1 + _EIGHT * y3
    return (
        y0,
        even_1 + odd_1,
        even_1 - odd_1,
        even_2 + odd_2,
        even_2 - odd_2,
        (np.float32(1.0) - last) * y3 + last * y4,
    )


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _place(tile: int, tiling: Tiling) -> Any:
    """The picture of a tile, and the row and the column of its first output there."""
    picture, rest = divmod(tile, tiling.n_down * tiling.n_across)
    down, across = divmod(rest, tiling.n_across)
    return picture, down * tiling.size, across * tiling.size


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def fold_pictures(pictures: NDArray[np.uint8], stride: int, run: int, folded: Floats) -> None:
    """Gives each block of s x s pixels the channels of all of them, in 0...1.

    Args:
        pictures: u8[B, H, W * C].
        stride: s.
        run: s * C.
        folded: f32[B, h, w * s * run]; gets the result, where there are pixels for it.
    """
    n_rows = min(folded.shape[1], pictures.shape[1] // stride)
    n_columns = min(folded.shape[2] // (stride * run), pictures.shape[2] // run)
    scale = np.float32(1.0 / 255.0)
    for picture in range(len(pictures)):
        for row in range(n_rows):
            blocks = folded[picture, row]
            for dy in range(stride):
                pixels = pictures[picture, stride * row + dy]
                for column in range(n_columns):
                    at = (column * stride + dy) * run
                    for k in range(run):
                        blocks[at + k] = scale * pixels[column * run + k]


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def transform_inputs(inputs: Floats, tiling: Tiling, transformed: Floats) -> None:
    """B' x B of each tile.

    Args:
        inputs: f32[B, s * h, w * run], where `run` counts the channels of s pixels of a row.
        tiling: Of the blocks of s x s pixels.
        transformed: f32[36, T, s * run]; gets the result.
    """
    run = transformed.shape[2] // tiling.stride
    passed = np.empty((POINTS, POINTS, run), np.float32)
    for tile in range(transformed.shape[1]):
        picture, down, across = _place(tile, tiling)
        for dy in range(tiling.stride):
            for p in range(POINTS):
                line = inputs[picture, tiling.stride * (down + p) + dy, across * run :]
                x0, x1, x2 = line[:run], line[run : 2 * run], line[2 * run : 3 * run]
                x3, x4, x5 = line[3 * run : 4 * run], line[4 * run : 5 * run], line[5 * run :]
                y0, y1, y2 = passed[p, 0], passed[p, 1], passed[p, 2]
                y3, y4, y5 = passed[p, 3], passed[p, 4], passed[p, 5]
                for k in range(run):
                    y0[k], y1[k], y2[k], y3[k], y4[k], y5[k] = _to_points(
                        x0[k], x1[k], x2[k], x3[k], x4[k], x5[k]
                    )
            at = slice(dy * run, (dy + 1) * run)
            for q in range(POINTS):
                x0, x1, x2 = passed[0, q], passed[1, q], passed[2, q]
                x3, x4, x5 = passed[3, q], passed[4, q], passed[5, q]
                y0, y1 = transformed[q, tile, at], transformed[6 + q, tile, at]
                y2, y3 = transformed[12 + q, tile, at], transformed[18 + q, tile, at]
                y4, y5 = transformed[24 + q, tile, at], transformed[30 + q, tile, at]
                for k in range(run):
                    y0[k], y1[k], y2[k], y3[k], y4[k], y5[k] = _to_points(
                        x0[k], x1[k], x2[k], x3[k], x4[k], x5[k]
                    )


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def add_input_gradients(transformed: Floats, tiling: Tiling, gradients: Floats) -> None:
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
                x0, x1 = transformed[q, tile, at], transformed[6 + q, tile, at]
                x2, x3 = transformed[12 + q, tile, at], transformed[18 + q, tile, at]
                x4, x5 = transformed[24 + q, tile, at], transformed[30 + q, tile, at]
                y0, y1, y2 = passed[0, q], passed[1, q], passed[2, q]
                y3, y4, y5 = passed[3, q], passed[4, q], passed[5, q]
                for k in range(run):
                    y0[k], y1[k], y2[k], y3[k], y4[k], y5[k] = _gradients_from_points(
                        x0[k], x1[k], x2[k], x3[k], x4[k], x5[k]
                    )
            for p in range(POINTS):
                line = gradients[picture, tiling.stride * (down + p) + dy, across * run :]
                x0, x1, x2 = passed[p, 0], passed[p, 1], passed[p, 2]
                x3, x4, x5 = passed[p, 3], passed[p, 4], passed[p, 5]
                y0, y1, y2 = line[:run], line[run : 2 * run], line[2 * run : 3 * run]
                y3, y4, y5 = line[3 * run : 4 * run], line[4 * run : 5 * run], line[5 * run :]
                for k in range(run):
                    v0, v1, v2, v3, v4, v5 = _gradients_from_points(
                        x0[k], x1[k], x2[k], x3[k], x4[k], x5[k]
                    )
                    y0[k] += v0
                    y1[k] += v1
                    y2[k] += v2
                    y3[k] += v3
                    y4[k] += v4
                    y5[k] += v5


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def transform_outputs(
    transformed: Floats, bias: Floats, tiling: Tiling, size: tuple[int, int], outputs: Floats
) -> None:
    """max(0, A' m A + bias) of each tile.

    Args:
        transformed: f32[36, T, O].
        bias: f32[O].
        tiling: Of the outputs.
        size: Rows and columns of outputs that there are; tiles reach beyond.
        outputs: f32[B, >= rows, >= columns * O]; these rows and columns get the result.
    """
    run = len(bias)
    passed = np.empty((_MOST_OUTPUTS, POINTS, run), np.float32)
    made = np.empty(_MOST_OUTPUTS * run, np.float32)
    biases = np.empty(_MOST_OUTPUTS * run, np.float32)
    for k in range(len(biases)):
        biases[k] = bias[k % run]
    last, zero = np.float32(tiling.size == _MOST_OUTPUTS), np.float32(0.0)
    for tile in range(transformed.shape[1]):
        picture, down, across = _place(tile, tiling)
        for q in range(POINTS):
            x0, x1, x2 = transformed[q, tile], transformed[6 + q, tile], transformed[12 + q, tile]
            x3, x4 = transformed[18 + q, tile], transformed[24 + q, tile]
            x5 = transformed[30 + q, tile]
            y0, y1, y2 = passed[0, q], passed[1, q], passed[2, q]
            y3, y4 = passed[3, q], passed[4, q]
            for k in range(run):
                y0[k], y1[k], y2[k], y3[k], y4[k] = _from_points(
                    x0[k], x1[k], x2[k], x3[k], x4[k], x5[k], last
                )
        width = min(tiling.size, size[1] - across) * run
        for row in range(min(tiling.size, size[0] - down)):
            x0, x1, x2 = passed[row, 0], passed[row, 1], passed[row, 2]
            x3, x4, x5 = passed[row, 3], passed[row, 4], passed[row, 5]
            y0, y1, y2 = made[:run], made[run : 2 * run], made[2 * run : 3 * run]
            y3, y4 = made[3 * run : 4 * run], made[4 * run :]
            for k in range(run):
                y0[k], y1[k], y2[k], y3[k], y4[k] = _from_points(
                    x0[k], x1[k], x2[k], x3[k], x4[k], x5[k], last
                )
            line = outputs[picture, down + row, across * run :]
            for k in range(width):
                value = made[k] + biases[k]
                line[k] = zero if value < zero else value


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def transform_output_gradients(
    gradients: Floats,
    outputs: Floats,
    tiling: Tiling,
    size: tuple[int, int],
    transformed: Floats,
    bias: Floats,
) -> None:
    """A y A' of each tile, after the ReLU; and the gradients of the bias.

    Args:
        gradients: By `outputs`, in their shape; what is beyond `size` counts for nothing.
        outputs: What `transform_outputs` gave.
        tiling: The same as there.
        size: The same as there.
        transformed: f32[36, T, O]; gets the result.
        bias: f32[O]; gets its gradients.
    """
    run = len(bias)
    passed = np.empty((_MOST_OUTPUTS, POINTS, run), np.float32)
    masked = np.empty(_MOST_OUTPUTS * run, np.float32)
    sums = np.zeros(_MOST_OUTPUTS * run, np.float32)
    last, zero = np.float32(tiling.size == _MOST_OUTPUTS), np.float32(0.0)
    for tile in range(transformed.shape[1]):
        picture, down, across = _place(tile, tiling)
        width = min(tiling.size, size[1] - across) * run
        n_rows = min(tiling.size, size[0] - down)
        masked[:] = 0.0
        passed[n_rows:] = 0.0
        for row in range(n_rows):
            given = gradients[picture, down + row, across * run :]
            units = outputs[picture, down + row, across * run :]
            for k in range(width):
                kept = zero if units[k] <= zero else given[k]
                masked[k] = kept
                sums[k] += kept
            x0, x1, x2 = masked[:run], masked[run : 2 * run], masked[2 * run : 3 * run]
            x3, x4 = masked[3 * run : 4 * run], masked[4 * run :]
            y0, y1, y2 = passed[row, 0], passed[row, 1], passed[row, 2]
            y3, y4, y5 = passed[row, 3], passed[row, 4], passed[row, 5]
            for k in range(run):
                y0[k], y1[k], y2[k], y3[k], y4[k], y5[k] = _gradients_to_points(
                    x0[k], x1[k], x2[k], x3[k], x4[k], last
                )
        for q in range(POINTS):
            x0, x1, x2 = passed[0, q], passed[1, q], passed[2, q]
            x3, x4 = passed[3, q], passed[4, q]
            y0, y1, y2 = transformed[q, tile], transformed[6 + q, tile], transformed[12 + q, tile]
            y3, y4 = transformed[18 + q, tile], transformed[24 + q, tile]
            y5 = transformed[30 + q, tile]
            for k in range(run):
                y0[k], y1[k], y2[k], y3[k], y4[k], y5[k] = _gradients_to_points(
                    x0[k], x1[k], x2[k], x3[k], x4[k], last
                )
    for k in range(run):
        bias[k] = sums[k] + sums[run + k] + sums[2 * run + k] + sums[3 * run + k]
        bias[k] += sums[4 * run + k]
