"""The gradient methods, both on torch's fused Adam kernel."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor, nn

from broker_config.errors import StorageError
from broker_config.preset import OptimiserPreset

_SATURATED_STEP = 2.0**24
"""A float32 step count that adding 1 does not change, and for which 1 - rho**count is 1."""


def build_optimiser(preset: OptimiserPreset, network: nn.Module) -> torch.optim.Adam:
    """The preset's optimiser for all parameters of a network, with its state allocated.

    RMSProp is the old Keras form, which the source's software had: v = rho * v + (1 - rho) * g**2
    and theta -= rate * g / (sqrt(v) + epsilon). That is Adam without momentum (beta1 = 0) and
    without bias correction (a step count so large that there is none left), so that the fused
    kernel serves both: one pass over the parameters, and one launch on a GPU.

    The state's tensors are never replaced, only written: a CUDA graph may hold their addresses.
    """
    device = next(network.parameters()).device
    is_rmsprop = preset.name == "rmsprop"
    optimiser = torch.optim.Adam(
        network.parameters(),
        lr=preset.learning_rate,
        betas=(0.0, preset.smoothing) if is_rmsprop else (0.9, 0.999),
        eps=preset.epsilon,
        fused=True,
        capturable=device.type == "cuda",
    )
    first_step = _SATURATED_STEP if is_rmsprop else 0.0
    for parameter in network.parameters():
        optimiser.state[parameter] = {
            "step": torch.tensor(first_step, dtype=torch.float32, device=device),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
        }
    return optimiser


def named_state(
    optimiser: torch.optim.Optimizer, network: nn.Module
) -> Iterator[tuple[str, Tensor]]:
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
