"""What products multiply: numbers of float32 or of bfloat16.

numba and numpy have no bfloat16: its numbers are the upper halves of float32's, and are u16 there.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from actors.compiled import compiler


def steps_compiler(*used: str) -> Any:
    """Compiles the loops of a gradient step; see `actors.compiled.compiler`."""
    # Without Python's lock, so that the learner's other threads need not wait.
    return compiler(*used, nogil=True, error_model="numpy", fastmath={"contract"})


Floats = NDArray[np.float32]
Factors = Floats | NDArray[np.uint16]
"""Numbers of float32, or of bfloat16 as u16."""


def as_array(factors: Tensor) -> Factors:
    """The very memory of a tensor of float32 or bfloat16, for compiled loops."""
    bits = factors.view(torch.uint16) if factors.dtype == torch.bfloat16 else factors
    return bits.numpy()
