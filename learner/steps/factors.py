"""What products multiply: numbers of float32 or of bfloat16.

numba and numpy have no bfloat16: its numbers are the upper halves of float32's, and are u16 there.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from actors.compiled import compiler

# Without Python's lock, so that the learner's other threads need not wait.
compiled: Any = compiler(nogil=True, error_model="numpy", fastmath={"contract"})
"""Compiles the loops of a gradient step."""

Factors = NDArray[np.float32] | NDArray[np.uint16]
"""Numbers of float32, or of bfloat16 as u16."""

_HALF, _LOW, _ONE = np.uint32(16), np.uint32(0x7FFF), np.uint32(1)


def as_array(factors: Tensor) -> Factors:
    """The very memory of a tensor of float32 or bfloat16, for compiled loops."""
    bits = factors.view(torch.uint16) if factors.dtype == torch.bfloat16 else factors
    return bits.numpy()


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def get(numbers: Any, k: int) -> Any:
    """In a compiled loop: a number as float32."""
    # Which of the two it is, is known when this is compiled.
    if numbers.itemsize == 4:
        return np.float32(numbers[k])
    return np.uint32(np.uint32(numbers[k]) << _HALF).view(np.float32)


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def put(numbers: Any, k: int, value: Any) -> None:
    """In a compiled loop: keeps a number, rounded to even if it is to be bfloat16."""
    if numbers.itemsize == 4:
        numbers[k] = value
    else:
        bits = np.float32(value).view(np.uint32)
        is_odd = np.uint32(np.uint32(bits >> _HALF) & _ONE)
        numbers[k] = np.uint16(np.uint32(np.uint32(bits + _LOW) + is_odd) >> _HALF)
