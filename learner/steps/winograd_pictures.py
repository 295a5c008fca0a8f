"""Winograd's transforms of pictures on their way through convolutions, compiled.

A convolution with stride 1 and r x r weights gives m x m outputs from a tile of n x n inputs,
n = m + r - 1. With the three small matrices A, B and G of the Cook-Toom algorithm it is

    Y = A' [(G g G') * (B' x B)] A

where * multiplies element by element. Over many tiles and channels each of the n * n elements is a
matrix product of its own, and there are (n / (m * r))**2 times as many multiplications as without:
16 instead of 36 for r = 2 and for r = 3. Gradients go through the transposed matrices, and save as
much.

n is 4 here throughout, from the points 0, 1, -1 and infinity, so that B is the same for m = 3,
r = 2 and for m = 2, r = 3, and that A and B only add and subtract: the error is about twice that of
the rounding before the products.

A stride of s is a stride of 1 over blocks of s x s inputs, if the weights' size is r * s: the
channels of a block are all those of its inputs.

Between two products a picture leaves the points of one layer and goes to those of the next, before
the next picture does: what lies between is still near the processor then. A tile is transformed in
registers, as many channels at a time as a vector has. What goes into the products and comes out of
them is float32 or bfloat16; all else is float32.

Source: Lavin and Gray, Fast algorithms for convolutional neural networks, 2016.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from learner.steps.factors import Factors, Floats
from learner.steps.vectors import (
    LANES,
    add_four,
    compiled,
    load,
    load_four,
    load_three,
    spread,
    store,
    store_four,
    store_three,
    zero_if_negative,
    zero_if_not_positive,
)

POINTS = 4
"""n: inputs of a tile along each axis."""

_ONE, _NOTHING, _SCALE = np.float32(1.0), np.float32(0.0), np.float32(1.0 / 255.0)


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

    @property
    def n_tiles(self) -> int:
        """Tiles of a picture."""
        return self.n_down * self.n_across


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def pictures_to_points(
    pictures: NDArray[np.uint8], tiling: Tiling, blocks: Floats, transformed: Factors
) -> None:
    """B' x B of each tile of pictures, whose numbers become 0...1.

    Args:
        pictures: u8[B, H, W, C].
        tiling: Of the blocks that the stride makes of the pixels; its own stride is 1.
        blocks: f32[1, h, w * I], 0 where only tiles reach; for one picture at a time.
        transformed: [16, T, I]; gets the result.
    """
    for picture in range(len(pictures)):
        _fold(pictures[picture], blocks[0], transformed.shape[2])
        _inputs_to_points(blocks, 0, tiling, transformed, picture)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def units_to_points(
    products: Factors,
    bias: Floats,
    tiling: Tiling,
    units: Floats,
    next_tiling: Tiling,
    transformed: Factors,
) -> None:
    """max(0, A' m A + bias) of each tile of a layer; then B' x B of each tile of the next.

    Args:
        products: m, [16, T, O].
        bias: f32[O].
        tiling: Of the outputs.
        units: f32[B, >= rows, >= columns * O]; these rows and columns get the layer's units, and
            the others, which only tiles of the next layer reach, are 0.
        next_tiling: Of the units, or of blocks of them.
        transformed: [16, T', O] or that of blocks; gets the result.
    """
    for picture in range(len(units)):
        _units_from_points(products, picture, bias, tiling, units)
        _inputs_to_points(units, picture, next_tiling, transformed, picture)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def units_to_features(
    products: Factors, bias: Floats, tiling: Tiling, units: Floats, features: Factors
) -> None:
    """max(0, A' m A + bias) of each tile of the last layer, by channel, then by row and column.

    Args:
        products: m, [16, T, O].
        bias: f32[O].
        tiling: Of the outputs.
        units: f32[B, rows, columns * O]; gets them as other layers do.
        features: [B, O * rows * columns]; gets them in its order.
    """
    n_channels, n_units = products.shape[2], features.shape[1]
    n_places = n_units // n_channels
    rounded = np.empty(n_units, features.dtype)
    for picture in range(len(units)):
        _units_from_points(products, picture, bias, tiling, units)
        made, ordered = units[picture].reshape(-1), features[picture]
        for k in range(0, n_units, LANES):
            store(rounded, k, load(made, k))
        for place in range(n_places):
            for channel in range(n_channels):
                ordered[channel * n_places + place] = rounded[place * n_channels + channel]


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def feature_gradients_to_points(
    features: Factors,
    units: Floats,
    passed: Floats,
    tiling: Tiling,
    transformed: Factors,
    bias: Floats,
) -> None:
    """A y A' of each tile of the last layer, after the ReLU; and the gradients of its bias.

    Args:
        features: Gradients by what `units_to_features` gave.
        units: What it left there.
        passed: f32[1, rows, columns * O], for the gradients by the units of one picture at a time.
        tiling: The same as there.
        transformed: [16, T, O]; gets the result.
        bias: f32[O]; its gradients are added.
    """
    n_channels, n_units = transformed.shape[2], features.shape[1]
    n_places = n_units // n_channels
    rounded = np.empty(n_units, features.dtype)
    given = passed.reshape(-1)
    for picture in range(len(units)):
        ordered = features[picture]
        for place in range(n_places):
            for channel in range(n_channels):
                rounded[place * n_channels + channel] = ordered[channel * n_places + place]
        for k in range(0, n_units, LANES):
            store(given, k, load(rounded, k))
        _unit_gradients_to_points(passed, units, picture, tiling, transformed, bias)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def unit_gradients_to_points(
    products: Factors,
    next_tiling: Tiling,
    units: Floats,
    passed: Floats,
    tiling: Tiling,
    transformed: Factors,
    bias: Floats,
) -> None:
    """B v B' of each tile of a layer, added; then A y A' of the one before it, after the ReLU.

    Args:
        products: v, gradients by what `units_to_points` gave.
        next_tiling: The same as there.
        units: What it left there.
        passed: f32[1, ...], else shaped like `units`: for the gradients by the units of one picture
            at a time.
        tiling: The same as there.
        transformed: [16, T, O]; gets the result.
        bias: f32[O]; its gradients are added.
    """
    for picture in range(len(units)):
        _gradients_from_points(products, picture, next_tiling, passed)
        _unit_gradients_to_points(passed, units, picture, tiling, transformed, bias)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _fold(picture: Any, blocks: Any, n_channels: int) -> None:
    """Gives each block of s x s pixels the channels of all of them, where there are pixels."""
    stride = int(math.sqrt(n_channels // picture.shape[2]))
    run = n_channels // stride
    n_columns = min(blocks.shape[1] // n_channels, picture.shape[1] // stride)
    line = np.empty(picture.shape[1] * picture.shape[2], np.float32)
    for row in range(min(blocks.shape[0], picture.shape[0] // stride)):
        made = blocks[row]
        for dy in range(stride):
            pixels = picture[stride * row + dy].reshape(-1)
            for k in range(len(line)):
                line[k] = _SCALE * pixels[k]
            for k in range(run):
                for column in range(n_columns):
                    made[(column * stride + dy) * run + k] = line[column * run + k]


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _inputs_to_points(
    inputs: Any, number: int, tiling: Tiling, transformed: Any, picture: int
) -> None:
    """B' x B of each tile of a picture.

    Args:
        inputs: f32[..., s * h, w * run], where `run` counts the channels of s inputs of a row.
        number: Which of them are the picture's.
        tiling: Of the inputs, or of blocks of them.
        transformed: [16, T, s * run]; its tiles get the result.
        picture: Which of those whose tiles are there.
    """
    _, n_tiles, n_channels = transformed.shape
    _, n_lines, line = inputs.shape
    stride, run = tiling.stride, n_channels // tiling.stride
    read, write = inputs.reshape(-1), transformed.reshape(-1)
    point, below = n_tiles * n_channels, stride * line
    to = picture * tiling.n_down * tiling.n_across * n_channels
    for down in range(tiling.n_down):
        for across in range(tiling.n_across):
            at = (number * n_lines + stride * tiling.size * down) * line
            at += across * tiling.size * run
            for _ in range(stride):
                for k in range(0, run, LANES):
                    a = _to_points(load_four(read, at + k, below))
                    b = _to_points(load_four(read, at + run + k, below))
                    c = _to_points(load_four(read, at + 2 * run + k, below))
                    d = _to_points(load_four(read, at + 3 * run + k, below))
                    w = _to_points((a[0], b[0], c[0], d[0]))
                    x = _to_points((a[1], b[1], c[1], d[1]))
                    y = _to_points((a[2], b[2], c[2], d[2]))
                    z = _to_points((a[3], b[3], c[3], d[3]))
                    _put_tile(write, to + k, point, w, x, y, z)
                at, to = at + line, to + run


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _units_from_points(products: Any, picture: int, bias: Any, tiling: Tiling, units: Any) -> None:
    """max(0, A' m A + bias) of each tile of a picture."""
    _, n_tiles, run = products.shape
    _, n_lines, line = units.shape
    read, write = products.reshape(-1), units.reshape(-1)
    point, row = n_tiles * run, POINTS * n_tiles * run
    last = spread(np.float32(tiling.size - 2))
    at = picture * tiling.n_down * tiling.n_across * run
    for down in range(0, tiling.n_down * tiling.size, tiling.size):
        n_rows = min(tiling.size, tiling.outputs[0] - down)
        for across in range(0, tiling.n_across * tiling.size, tiling.size):
            n_columns = min(tiling.size, tiling.outputs[1] - across)
            to = (picture * n_lines + down) * line + across * run
            for k in range(0, run, LANES):
                a = _from_points(load_four(read, at + k, row), last)
                b = _from_points(load_four(read, at + point + k, row), last)
                c = _from_points(load_four(read, at + 2 * point + k, row), last)
                d = _from_points(load_four(read, at + 3 * point + k, row), last)
                shift = load(bias, k)
                x = _active(_from_points((a[0], b[0], c[0], d[0]), last), shift)
                store_three(write, to + k, run, n_columns, x)
                if n_rows > 1:
                    y = _active(_from_points((a[1], b[1], c[1], d[1]), last), shift)
                    store_three(write, to + line + k, run, n_columns, y)
                if n_rows > 2:
                    z = _active(_from_points((a[2], b[2], c[2], d[2]), last), shift)
                    store_three(write, to + 2 * line + k, run, n_columns, z)
            at += run


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _gradients_from_points(products: Any, picture: int, tiling: Tiling, passed: Any) -> None:
    """B v B' of each tile of a picture, added where tiles overlap."""
    _, n_tiles, n_channels = products.shape
    line = passed.shape[2]
    stride, run = tiling.stride, n_channels // tiling.stride
    read, write = products.reshape(-1), passed.reshape(-1)
    point, row, below = n_tiles * n_channels, POINTS * n_tiles * n_channels, stride * line
    write[:] = _NOTHING
    at = picture * tiling.n_down * tiling.n_across * n_channels
    for down in range(tiling.n_down):
        for across in range(tiling.n_across):
            to = stride * tiling.size * down * line + across * tiling.size * run
            for _ in range(stride):
                for k in range(0, run, LANES):
                    a = _back_from_points(load_four(read, at + k, row))
                    b = _back_from_points(load_four(read, at + point + k, row))
                    c = _back_from_points(load_four(read, at + 2 * point + k, row))
                    d = _back_from_points(load_four(read, at + 3 * point + k, row))
                    w = _back_from_points((a[0], b[0], c[0], d[0]))
                    x = _back_from_points((a[1], b[1], c[1], d[1]))
                    y = _back_from_points((a[2], b[2], c[2], d[2]))
                    z = _back_from_points((a[3], b[3], c[3], d[3]))
                    add_four(write, to + k, run, w)
                    add_four(write, to + below + k, run, x)
                    add_four(write, to + 2 * below + k, run, y)
                    add_four(write, to + 3 * below + k, run, z)
                at, to = at + run, to + line


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _unit_gradients_to_points(
    passed: Any, units: Any, picture: int, tiling: Tiling, transformed: Any, bias: Any
) -> None:
    """A y A' of each tile of a picture, after the ReLU; and the gradients of the bias."""
    _, n_tiles, run = transformed.shape
    line = units.shape[2]
    given, made, write = passed.reshape(-1), units[picture].reshape(-1), transformed.reshape(-1)
    point, last = n_tiles * run, spread(np.float32(tiling.size - 2))
    to = picture * tiling.n_down * tiling.n_across * run
    for down in range(0, tiling.n_down * tiling.size, tiling.size):
        n_rows = min(tiling.size, tiling.outputs[0] - down)
        for across in range(0, tiling.n_across * tiling.size, tiling.size):
            n = min(tiling.size, tiling.outputs[1] - across)
            at = down * line + across * run
            for k in range(0, run, LANES):
                x = _kept(given, made, at + k, run, n)
                y = _kept(given, made, at + line + k, run, n if n_rows > 1 else 0)
                z = _kept(given, made, at + 2 * line + k, run, n if n_rows > 2 else 0)
                sums = x[0] + x[1] + x[2] + (y[0] + y[1] + y[2]) + (z[0] + z[1] + z[2])
                store(bias, k, load(bias, k) + sums)
                a = _back_to_points((x[0], y[0], z[0]), last)
                b = _back_to_points((x[1], y[1], z[1]), last)
                c = _back_to_points((x[2], y[2], z[2]), last)
                w = _back_to_points((a[0], b[0], c[0]), last)
                x = _back_to_points((a[1], b[1], c[1]), last)
                y = _back_to_points((a[2], b[2], c[2]), last)
                z = _back_to_points((a[3], b[3], c[3]), last)
                _put_tile(write, to + k, point, w, x, y, z)
            to += run


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _to_points(x: Any) -> Any:
    """B' x."""
    return x[0] - x[2], x[1] + x[2], x[2] - x[1], x[3] - x[1]


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _back_from_points(v: Any) -> Any:
    """B v."""
    return v[0], v[1] - v[2] - v[3], v[1] + v[2] - v[0], v[3]


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _from_points(m: Any, last: Any) -> Any:
    """A' m, three outputs; `last` is 1 if the third is one, 0 if there are two."""
    total, difference = m[1] + m[2], m[1] - m[2]
    return m[0] + total, difference + (spread(_ONE) - last) * m[3], total + last * m[3]


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _back_to_points(y: Any, last: Any) -> Any:
    """A y; the third is 0 if there are two outputs."""
    even = y[0] + y[2]
    return y[0], even + y[1], even - y[1], (spread(_ONE) - last) * y[1] + last * y[2]


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _active(sums: Any, bias: Any) -> Any:
    """max(0, x + bias) of three; but NaN stays NaN."""
    x, y, z = sums[0] + bias, sums[1] + bias, sums[2] + bias
    return zero_if_negative(x, x), zero_if_negative(y, y), zero_if_negative(z, z)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _kept(gradients: Any, units: Any, at: int, step: int, n: int) -> Any:
    """Gradients by three sums, from those by the units that a ReLU made of them."""
    x, y = load_three(units, at, step, n), load_three(gradients, at, step, n)
    return (
        zero_if_not_positive(x[0], y[0]),
        zero_if_not_positive(x[1], y[1]),
        zero_if_not_positive(x[2], y[2]),
    )


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _put_tile(numbers: Any, at: int, point: int, w: Any, x: Any, y: Any, z: Any) -> None:
    """Four rows of a tile, at points that are so many numbers apart."""
    store_four(numbers, at, point, w)
    store_four(numbers, at + POINTS * point, point, x)
    store_four(numbers, at + 2 * POINTS * point, point, y)
    store_four(numbers, at + 3 * POINTS * point, point, z)
