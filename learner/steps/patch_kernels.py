"""Patches of pictures taken apart and added up again, compiled: bfloat16, but sums in float32.

numba has no bfloat16. Its numbers are the upper halves of float32's, and are u16 here.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.compiled import compiler

# Without Python's lock, so that the learner's other threads need not wait.
_compiled: Any = compiler(nogil=True, error_model="numpy")

_HALF, _LOW = np.uint32(16), np.uint32(0x7FFF)

WORD = 4
"""Numbers of bfloat16 that `take_patches` moves at a time."""


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _wide(number: Any) -> Any:
    """A number of bfloat16 as float32."""
    return np.uint32(np.uint32(number) << _HALF).view(np.float32)


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def take_patches(
    lines: NDArray[np.int64],
    size: tuple[int, int],
    kernel: int,
    steps: tuple[int, int],
    patches: NDArray[np.int64],
) -> None:
    """Makes each patch of the pictures a row of a matrix. Lengths are in words of `WORD` numbers.

    Args:
        lines: i64[B, H, w], the rows of pictures.
        size: Rows and columns of patches in a picture.
        kernel: Rows of a patch.
        steps: From one patch to the next: down in rows, across in words.
        patches: i64[B * rows * columns, kernel * run]; gets the result.
    """
    run = patches.shape[1] // kernel
    n = 0
    for picture in lines:
        for row in range(size[0]):
            for column in range(size[1]):
                for dy in range(kernel):
                    line, patch = picture[row * steps[0] + dy], patches[n]
                    for k in range(run):
                        patch[dy * run + k] = line[column * steps[1] + k]
                n += 1


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def add_patches(
    patches: NDArray[np.uint16],
    size: tuple[int, int],
    kernel: int,
    steps: tuple[int, int],
    units: NDArray[np.uint16],
    gradients: NDArray[np.uint16],
) -> None:
    """Adds each patch to where it was taken from, and passes the ReLU that made the pictures.

    Args:
        patches: Gradients by what `take_patches` gives, bf16[B * rows * columns, kernel * run].
        size: Rows and columns of patches in a picture.
        kernel: Rows of a patch.
        steps: From one patch to the next: down in rows, across in numbers.
        units: What the ReLU gave, bf16[B, H, w].
        gradients: The same shape; gets the sums, rounded to even, and 0 where the units are 0.
    """
    run = patches.shape[1] // kernel
    sums = np.empty(gradients.shape[1:], np.float32)
    bits = sums.view(np.uint32)
    n = 0
    for picture in range(len(gradients)):
        sums[:] = np.float32(0.0)
        for row in range(size[0]):
            for column in range(size[1]):
                at = column * steps[1]
                for dy in range(kernel):
                    line = sums[row * steps[0] + dy, at : at + run]
                    patch = patches[n, dy * run : (dy + 1) * run]
                    for k in range(run):
                        line[k] += _wide(patch[k])
                n += 1
        for row in range(len(sums)):
            line, kept, given = bits[row], units[picture, row], gradients[picture, row]
            for k in range(len(line)):
                is_odd = np.uint32(np.uint32(line[k] >> _HALF) & np.uint32(1))
                rounded = np.uint32(np.uint32(line[k] + _LOW) + is_odd) >> _HALF
                given[k] = rounded if kept[k] else np.uint16(0)


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def sum_rows(rows: NDArray[np.uint16], sums: NDArray[np.float32]) -> None:
    """Adds up the rows of a matrix, bf16[n, O], into f32[O]."""
    sums[:] = np.float32(0.0)
    whole = len(rows) // 4 * 4
    for n in range(0, whole, 4):
        a, b, c, d = rows[n], rows[n + 1], rows[n + 2], rows[n + 3]
        for k in range(len(sums)):
            sums[k] += (_wide(a[k]) + _wide(b[k])) + (_wide(c[k]) + _wide(d[k]))
    for n in range(whole, len(rows)):
        for k in range(len(sums)):
            sums[k] += _wide(rows[n, k])
