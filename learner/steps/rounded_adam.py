"""Adam's step on weights whose gradients are bfloat16 and of which a rounded copy is kept.

With few samples in a minibatch it is memory that a step waits for. This one passes it once: no
gradient is widened before, and no weight is rounded after it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.steps.factors import as_array, compiled

if TYPE_CHECKING:
    from learner.steps.optimiser import FusedAdam

Floats = NDArray[np.float32]
Bits = NDArray[np.uint16]
"""Numbers of bfloat16."""

_HALF, _LOW, _ONE = np.uint32(16), np.uint32(0x7FFF), np.uint32(1)


@torch.no_grad()
def step_rounded(
    optimiser: FusedAdam, parameter: Tensor, gradients: Tensor, rounded: Tensor
) -> None:
    """Makes the step of `FusedAdam.step` with one parameter.

    Args:
        optimiser: Of the parameter; its state goes on by a step.
        parameter: f32[...], contiguous.
        gradients: bf16, of the same shape.
        rounded: bf16, of the same shape; gets what the parameter has become.
    """
    state, (beta1, beta2) = optimiser.state[parameter], optimiser.betas
    n_steps = state["step"].add_(1.0).item()
    _step(
        parameter.view(-1).numpy(),
        as_array(gradients.view(-1)),
        state["exp_avg"].view(-1).numpy(),
        state["exp_avg_sq"].view(-1).numpy(),
        as_array(rounded.view(-1)),
        np.float32(beta1),
        np.float32(beta2),
        np.float32(optimiser.learning_rate / (1.0 - beta1**n_steps)),
        np.float32(1.0 / math.sqrt(1.0 - beta2**n_steps)),
        np.float32(optimiser.epsilon),
    )


@compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _step(
    parameter: Floats,
    gradients: Bits,
    mean: Floats,
    square: Floats,
    rounded: Bits,
    beta1: np.float32,
    beta2: np.float32,
    step_size: np.float32,
    correction: np.float32,
    epsilon: np.float32,
) -> None:
    rate1, rate2 = np.float32(1.0) - beta1, np.float32(1.0) - beta2
    for k in range(len(parameter)):
        gradient = np.uint32(np.uint32(gradients[k]) << _HALF).view(np.float32)
        m = beta1 * mean[k] + rate1 * gradient
        v = beta2 * square[k] + (rate2 * gradient) * gradient
        after = parameter[k] - step_size * m / (np.sqrt(v) * correction + epsilon)
        mean[k], square[k], parameter[k] = m, v, after
        bits = np.float32(after).view(np.uint32)
        is_odd = np.uint32(np.uint32(bits >> _HALF) & _ONE)
        rounded[k] = np.uint16(np.uint32(np.uint32(bits + _LOW) + is_odd) >> _HALF)
