"""The gradient steps on a CPU, written as matrix products into buffers that are kept.

Hardly anything is allocated or reordered in a step. Only the head, which is small and has three
forms, is left to autograd, in float32. Parameters and the optimiser's state are float32, too. Of
the layers below the head, all that goes into a product and all that comes out of one may be
bfloat16; what is added up or transformed in between is float32.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from actors.networks import PreferenceNetwork
from learner.memory import LocalMemory
from learner.steps.compute import EVALUATED_AT_ONCE
from learner.steps.optimiser import FusedAdam
from learner.steps.winograd import WinogradConvolutions


class ProductSteps:
    """Makes the steps by matrix products; equals `EagerSteps` up to rounding."""

    def __init__(
        self,
        network: PreferenceNetwork,
        optimiser: FusedAdam,
        memory: LocalMemory,
        factors: torch.dtype,
    ) -> None:
        """Prepares nothing yet: buffers are made when a minibatch size is met.

        Args:
            network: On the CPU, in the layout that `build_network` gives.
            optimiser: From `build_optimiser`, for the network.
            memory: Gives pictures and actions.
            factors: What is multiplied: float32 or bfloat16.
        """
        self._network = network
        self._optimiser = optimiser
        self._memory = memory
        self._factors = factors
        self._trunk: _Trunk | None = None

    def run(self, batches: Tensor, targets: Tensor) -> Tensor:
        """See `GradientSteps.run`."""
        batch_size = batches.shape[1]
        # One size at a time: a memory that is smaller than a minibatch has another at each update.
        if self._trunk is None or self._trunk.batch_size != batch_size:
            self._trunk = _Trunk(self._network, batch_size, self._factors)
        trunk = self._trunk
        positions, actions = self._memory.ring_positions, self._memory.samples.actions
        losses = torch.empty(len(batches))
        trunk.follow()
        for step, batch in enumerate(batches):
            hidden = trunk.forward(self._memory.learned_from.index_select(0, positions[batch]))
            self._optimiser.zero_grad()
            losses[step] = self._head_step(hidden, actions[batch], targets[batch])
            trunk.backward([units.grad for units in hidden], self._optimiser)
            self._optimiser.step()
        return losses

    def _head_step(self, hidden: list[Tensor], actions: Tensor, targets: Tensor) -> Tensor:
        """The minibatch's loss; leaves gradients at the head's parameters and at its inputs."""
        preferences = self._network.head(*hidden)
        chosen = preferences.gather(1, actions.unsqueeze(1)).squeeze(1)
        loss = functional.mse_loss(chosen, targets)
        loss.backward()  # type: ignore[no-untyped-call]
        return loss.detach()


class ProductEvaluation:
    """Computes preferences as steps do; equals the network up to rounding."""

    def __init__(self, network: PreferenceNetwork, factors: torch.dtype) -> None:
        """Allocates what it needs.

        Args:
            network: On the CPU, in the layout that `build_network` gives.
            factors: What is multiplied: float32 or bfloat16.
        """
        self._network = network
        self._trunk = _Trunk(network, EVALUATED_AT_ONCE, factors)

    @torch.no_grad()
    def __call__(self, pictures: Tensor) -> Tensor:
        """P(s, a) of any number of pictures, f32[n, A].

        Args:
            pictures: u8[n, H, W, C].
        """
        preferences = []
        self._trunk.follow()
        for part in torch.split(pictures, EVALUATED_AT_ONCE):
            missing = EVALUATED_AT_ONCE - len(part)
            full = (
                torch.cat([part, part.new_zeros((missing, *part.shape[1:]))]) if missing else part
            )
            preferences.append(self._network.head(*self._trunk.forward(full))[: len(part)])
        return torch.cat(preferences)


class _Trunk:
    """All layers below the head, for minibatches of one size."""

    def __init__(self, network: PreferenceNetwork, batch_size: int, factors: torch.dtype) -> None:
        self.batch_size = batch_size
        self._convolutions = WinogradConvolutions(network, batch_size, factors)
        self._feature_gradients = torch.empty_like(self._convolutions.features)
        self._hidden = [
            _Hidden(layer, self._convolutions.features) for layer in network.hidden_layers
        ]

    def follow(self) -> None:
        """Follows parameters that something else has changed than these steps."""
        for layer in self._hidden:
            layer.follow()

    @torch.no_grad()
    def forward(self, pictures: Tensor) -> list[Tensor]:
        """Hidden units f32[B, 512] of each stream, as leaves of the head's graph.

        Args:
            pictures: u8[B, H, W, C].
        """
        self._convolutions.forward(pictures)
        return [layer.forward().requires_grad_() for layer in self._hidden]

    @torch.no_grad()
    def backward(self, unit_gradients: list[Tensor | None], optimiser: FusedAdam) -> None:
        """Leaves the gradients of the loss at the parameters, or has made their steps.

        Args:
            unit_gradients: Of the loss by what `forward` gave.
            optimiser: Makes the steps of rounded weights, whose gradients are still near then.
        """
        for number, (layer, gradients) in enumerate(zip(self._hidden, unit_gradients, strict=True)):
            assert gradients is not None
            layer.backward(gradients, self._feature_gradients, optimiser, accumulate=number > 0)
        self._convolutions.backward(self._feature_gradients)


class _Hidden:
    """A fully connected layer on the features, and the ReLU after it.

    Most of a network's weights are here. If they are rounded, they are so once in a step, by the
    optimiser, which passes over them anyway.
    """

    def __init__(self, layer: nn.Linear, features: Tensor) -> None:
        self._layer, self._features = layer, features
        self._is_exact = features.dtype == torch.float32
        weight = layer.weight.detach()
        self._factors = weight if self._is_exact else weight.to(features.dtype)
        self._weight_gradients = torch.empty_like(self._factors)
        self._bias_gradients = torch.empty_like(layer.bias)
        self._units = torch.empty(0)

    def follow(self) -> None:
        """See `_Trunk.follow`."""
        if not self._is_exact:
            self._factors.copy_(self._layer.weight.detach())

    def forward(self) -> Tensor:
        """max(0, x W' + b) of the features, f32[B, 512]."""
        # Weights first: the other way round they would be reordered for the product.
        sums = torch.mm(self._factors, self._features.t())
        self._units = torch.add(sums.t(), self._layer.bias).relu_()
        return self._units.detach()

    def backward(
        self,
        gradients: Tensor,
        feature_gradients: Tensor,
        optimiser: FusedAdam,
        *,
        accumulate: bool,
    ) -> None:
        """Leaves the parameters' gradients, or makes their steps; gives those of the features.

        Args:
            gradients: Of the loss by what `forward` gave.
            feature_gradients: [B, I].
            optimiser: Makes the step of rounded weights.
            accumulate: Whether to add to them.
        """
        passed = gradients.masked_fill(self._units == 0, 0.0)
        self._layer.bias.grad = torch.sum(passed, 0, out=self._bias_gradients)
        passed = passed.to(self._factors.dtype)
        if accumulate:
            feature_gradients.addmm_(passed, self._factors)
        else:
            torch.mm(passed, self._factors, out=feature_gradients)
        torch.mm(passed.t(), self._features, out=self._weight_gradients)
        if self._is_exact:
            self._layer.weight.grad = self._weight_gradients
        else:
            optimiser.step_rounded(self._layer.weight, self._weight_gradients, self._factors)
