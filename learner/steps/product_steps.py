"""The gradient steps on a CPU, written as matrix products into buffers that are kept.

Gradients are written straight into the memory of the network's own parameters, and hardly anything
is allocated or reordered in a step. Only the head, which is small and has three forms, is left to
autograd, in float32. Parameters, teaching signals and the optimiser's state are float32, too,
whatever the layers below compute with.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from actors.networks import PreferenceNetwork
from learner.memory import LocalMemory
from learner.steps.compute import EVALUATED_AT_ONCE
from learner.steps.optimiser import FusedAdam
from learner.steps.weight_matrix import WeightMatrix, forward_with_relu, pass_relu


class Convolutions(Protocol):
    """All convolutions of a network, for minibatches of one size."""

    @property
    def maps(self) -> Tensor:
        """Units [B, h, w, C] of the last convolution, always the same memory."""

    def forward(self, pictures: Tensor) -> None:
        """Computes the maps.

        Args:
            pictures: u8[B, H, W, C].
        """

    def backward(self, gradients: Tensor) -> None:
        """Leaves the gradients of the loss at the convolutions' parameters.

        Args:
            gradients: Of the loss by the maps, in their shape.
        """


class ProductSteps:
    """Makes the steps by matrix products; equals `EagerSteps` up to rounding."""

    def __init__(
        self,
        network: PreferenceNetwork,
        optimiser: FusedAdam,
        memory: LocalMemory,
        make_convolutions: Callable[[PreferenceNetwork, int], Convolutions],
    ) -> None:
        """Prepares nothing yet: buffers are made when a minibatch size is met.

        Args:
            network: On the CPU, in the layout that `build_network` gives.
            optimiser: From `build_optimiser`, for the network.
            memory: Gives pictures and actions.
            make_convolutions: Of the network, for minibatches of a size.
        """
        self._network = network
        self._optimiser = optimiser
        self._memory = memory
        self._make_convolutions = make_convolutions
        self._trunk: _Trunk | None = None

    def run(self, batches: Tensor, targets: Tensor) -> Tensor:
        """See `GradientSteps.run`."""
        batch_size = batches.shape[1]
        # One size at a time: a memory that is smaller than a minibatch has another at each update.
        if self._trunk is None or self._trunk.batch_size != batch_size:
            convolutions = self._make_convolutions(self._network, batch_size)
            self._trunk = _Trunk(self._network, convolutions)
        trunk = self._trunk
        positions, actions = self._memory.ring_positions, self._memory.samples.actions
        losses = torch.empty(len(batches))
        for step, batch in enumerate(batches):
            hidden = trunk.forward(self._memory.ring.index_select(0, positions[batch]))
            self._optimiser.zero_grad()
            losses[step] = self._head_step(hidden, actions[batch], targets[batch])
            trunk.backward([units.grad for units in hidden])
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
    """Computes preferences by matrix products; equals the network up to rounding."""

    def __init__(
        self,
        network: PreferenceNetwork,
        make_convolutions: Callable[[PreferenceNetwork, int], Convolutions],
    ) -> None:
        """Prepares it; the arguments are those of `ProductSteps`."""
        self._network = network
        self._trunk = _Trunk(network, make_convolutions(network, EVALUATED_AT_ONCE))

    @torch.no_grad()
    def __call__(self, pictures: Tensor) -> Tensor:
        """P(s, a) of any number of pictures, f32[n, A].

        Args:
            pictures: u8[n, H, W, C].
        """
        preferences = []
        for part in torch.split(pictures, EVALUATED_AT_ONCE):
            missing = EVALUATED_AT_ONCE - len(part)
            full = (
                torch.cat([part, part.new_zeros((missing, *part.shape[1:]))]) if missing else part
            )
            preferences.append(self._network.head(*self._trunk.forward(full))[: len(part)])
        return torch.cat(preferences)


class _Trunk:
    """All layers below the head, for minibatches of one size."""

    def __init__(self, network: PreferenceNetwork, convolutions: Convolutions) -> None:
        maps = convolutions.maps
        self.batch_size = len(maps)
        self._convolutions = convolutions
        # The network's features are ordered by channel first.
        self._features = maps.new_empty((len(maps), maps[0].numel()))
        self._feature_gradients = torch.empty_like(self._features)
        self._hidden = [_Hidden(layer, self._features) for layer in network.hidden_layers]

    @torch.no_grad()
    def forward(self, pictures: Tensor) -> list[Tensor]:
        """Hidden units f32[B, 512] of each stream, as leaves of the head's graph.

        Args:
            pictures: u8[B, H, W, C].
        """
        self._convolutions.forward(pictures)
        self._by_channel(self._features).copy_(self._convolutions.maps)
        units = [layer.forward() for layer in self._hidden]
        return [each.to(torch.float32, copy=True).requires_grad_() for each in units]

    @torch.no_grad()
    def backward(self, unit_gradients: list[Tensor | None]) -> None:
        """Leaves the gradients of the loss at the layers' parameters."""
        for number, (layer, gradients) in enumerate(zip(self._hidden, unit_gradients, strict=True)):
            assert gradients is not None
            layer.backward(gradients, self._feature_gradients, accumulate=number > 0)
        self._convolutions.backward(self._by_channel(self._feature_gradients))

    def _by_channel(self, features: Tensor) -> Tensor:
        """A view of features [B, C * h * w] with the axes of the maps [B, h, w, C]."""
        batch_size, height, width, channels = self._convolutions.maps.shape
        return features.view(batch_size, channels, height, width).permute(0, 2, 3, 1)


class _Hidden:
    """A fully connected layer on the features, and the ReLU after it."""

    def __init__(self, layer: nn.Linear, features: Tensor) -> None:
        self._features = features
        self._weights = WeightMatrix(layer, tuple(layer.weight.shape), features.dtype, 1.0)
        self._units = features.new_empty((len(features), layer.out_features))
        self._gradients = torch.empty_like(self._units)

    def forward(self) -> Tensor:
        forward_with_relu(self._features, self._weights, self._units)
        return self._units

    def backward(self, gradients: Tensor, feature_gradients: Tensor, *, accumulate: bool) -> None:
        self._gradients.copy_(gradients)
        pass_relu(self._gradients, self._units)
        self._weights.set_gradients(self._gradients, self._features)
        if accumulate:
            feature_gradients.addmm_(self._gradients, self._weights.rounded)
        else:
            torch.mm(self._gradients, self._weights.rounded, out=feature_gradients)
