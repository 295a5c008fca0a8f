"""The gradient methods, both as Adam: by torch's kernel; by our own where weights are rounded."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
import torch
from torch import Tensor, nn

from broker_config.errors import StorageError
from broker_config.preset import OptimiserPreset

_SATURATED_STEP = 2.0**24
"""A float32 step count that adding 1 does not change, and for which 1 - rho**count is 1."""


class FusedAdam:
    """Adam on torch's fused kernel, with its state allocated.

    It makes the very steps of `torch.optim.Adam`, which as soon as it is made imports torch's
    compiler: that takes longer than importing all the rest of torch, and nothing is compiled here.

    The state's tensors are never replaced, only written: a CUDA graph may hold their addresses.

    Attributes:
        state: "step" f32[], "exp_avg" and "exp_avg_sq" of each parameter.
    """

    def __init__(
        self,
        network: nn.Module,
        learning_rate: float,
        betas: tuple[float, float],
        epsilon: float,
        first_step: float = 0.0,
    ) -> None:
        """Allocates the state of all parameters of a network; steps count from `first_step`."""
        self._parameters = list(network.parameters())
        self._learning_rate = learning_rate
        self._betas = betas
        self._epsilon = epsilon
        self.state: dict[Tensor, dict[str, Tensor]] = {
            parameter: {
                "step": torch.tensor(first_step, dtype=torch.float32, device=parameter.device),
                "exp_avg": torch.zeros_like(parameter),
                "exp_avg_sq": torch.zeros_like(parameter),
            }
            for parameter in self._parameters
        }

    def zero_grad(self) -> None:
        """Forgets the gradients: backward then writes new ones instead of adding to them."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step_rounded(self, parameter: Tensor, gradients: Tensor, rounded: Tensor) -> None:
        """Makes the step with one parameter, by our own kernel.

        Args:
            parameter: f32[...], contiguous.
            gradients: bf16, of the same shape.
            rounded: bf16, of the same shape; gets what the parameter has become.
        """
        # Not above: they import numba, for which processes that make no steps need not wait.
        from learner.steps.factors import as_array
        from learner.steps.rounded_adam import adam_step

        state, (beta1, beta2) = self.state[parameter], self._betas
        n_steps = state["step"].add_(1.0).item()
        adam_step(
            parameter.view(-1).numpy(),
            as_array(gradients.view(-1)),
            state["exp_avg"].view(-1).numpy(),
            state["exp_avg_sq"].view(-1).numpy(),
            as_array(rounded.view(-1)),
            np.float32(beta1),
            np.float32(beta2),
            np.float32(self._learning_rate / (1.0 - beta1**n_steps)),
            np.float32(1.0 / math.sqrt(1.0 - beta2**n_steps)),
            np.float32(self._epsilon),
        )

    @torch.no_grad()
    def step(self) -> None:
        """Makes a step with every parameter that has a gradient."""
        steps = [(it, it.grad, self.state[it]) for it in self._parameters if it.grad is not None]
        if not steps:
            return
        counts = [state["step"] for _, _, state in steps]
        torch._foreach_add_(counts, 1)
        torch._fused_adam_(
            [parameter for parameter, _, _ in steps],
            [gradient for _, gradient, _ in steps],
            [state["exp_avg"] for _, _, state in steps],
            [state["exp_avg_sq"] for _, _, state in steps],
            [],
            counts,
            lr=self._learning_rate,
            beta1=self._betas[0],
            beta2=self._betas[1],
            weight_decay=0.0,
            eps=self._epsilon,
            amsgrad=False,
            maximize=False,
        )


def build_optimiser(preset: OptimiserPreset, network: nn.Module) -> FusedAdam:
    """The preset's optimiser for all parameters of a network.

    RMSProp is the old Keras form, which the source's software had: v = rho * v + (1 - rho) * g**2
    and theta -= rate * g / (sqrt(v) + epsilon). That is Adam without momentum (beta1 = 0) and
    without bias correction (a step count so large that there is none left), so that one
    kernel serves both: one pass over the parameters, and one launch on a GPU.
    """
    rate, epsilon = preset.learning_rate, preset.epsilon
    if preset.name == "rmsprop":
        return FusedAdam(network, rate, (0.0, preset.smoothing), epsilon, _SATURATED_STEP)
    return FusedAdam(network, rate, (0.9, 0.999), epsilon)


def named_state(optimiser: FusedAdam, network: nn.Module) -> Iterator[tuple[str, Tensor]]:
    """The optimiser's own tensors (not copies), named after the parameters that they belong to."""
    for name, parameter in network.named_parameters():
        for part, tensor in sorted(optimiser.state[parameter].items()):
            yield f"{name}.{part}", tensor


def overwrite(tensors: Mapping[str, Tensor], state: Mapping[str, Tensor], subject: str) -> None:
    """Writes a saved state into existing tensors, without replacing them.

    Raises:
        StorageError: The names or shapes differ; nothing is written then.
    """
    if tensors.keys() != state.keys():
        differing = sorted(tensors.keys() ^ state.keys())[0]
        raise _foreign(subject, "the tensors of this preset", f"a difference in {differing}")
    for name, tensor in tensors.items():
        got = state[name]
        if got.shape != tensor.shape or got.dtype != tensor.dtype:
            rule = f"{name} {tensor.dtype} {list(tensor.shape)}"
            raise _foreign(subject, rule, f"{got.dtype} {list(got.shape)}")
    with torch.no_grad():
        for name, tensor in tensors.items():
            tensor.copy_(state[name])


def _foreign(subject: str, rule: str, got: str) -> StorageError:
    return StorageError(
        f"{subject}: expected {rule}; got {got}; the checkpoint belongs to another preset"
    )
