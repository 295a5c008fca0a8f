"""Adam's step on weights whose gradients are bfloat16 and of which a rounded copy is kept.

With few samples in a minibatch it is memory that a step waits for. This one passes it once: no
gradient is widened before, and no weight is rounded after it.
"""

import numpy as np

from learner.steps.factors import Factors, Floats, steps_compiler

_HALF, _LOW, _ONE = np.uint32(16), np.uint32(0x7FFF), np.uint32(1)


@steps_compiler()  # type: ignore[untyped-decorator] # numba publishes no types
def adam_step(
    parameter: Floats,
    gradients: Factors,
    mean: Floats,
    square: Floats,
    rounded: Factors,
    beta1: np.float32,
    beta2: np.float32,
    step_size: np.float32,
    correction: np.float32,
    epsilon: np.float32,
) -> None:
    """Makes the step with one parameter.

    Args:
        parameter: f32[n].
        gradients: bf16[n].
        mean: Of the gradients, f32[n]; goes on.
        square: Mean of their squares, f32[n]; goes on.
        rounded: bf16[n]; gets what the parameter has become.
        beta1: What is kept of the mean.
        beta2: What is kept of the mean of squares.
        step_size: With the mean's bias correction.
        correction: What the root of the mean of squares is multiplied with.
        epsilon: Added to that root.
    """
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
