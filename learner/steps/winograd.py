"""The network's convolutions by Winograd's algorithm: the same results by fewer multiplications.

Of the multiplications of a step it leaves about a half; `winograd_pictures` tells how. Those that
are left are matrix products again, 16 at a time, and torch makes them: of float32, or of factors
that are rounded to bfloat16 right before. A few pictures at a time go through all layers, so that
what one leaves is still near the processor when the next one reads it.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from actors.networks import PreferenceNetwork
from learner.steps.factors import Factors, Floats, as_array
from learner.steps.winograd_pictures import (
    POINTS,
    Tiling,
    feature_gradients_to_points,
    pictures_to_points,
    unit_gradients_to_points,
    units_to_features,
    units_to_points,
)
from learner.steps.winograd_weights import weight_gradients_from_points, weights_to_points

_PICTURES_AT_ONCE = 32
"""Fewer would be nearer still, but products of few rows are slow."""


class WinogradConvolutions:
    """All convolutions of a network, for minibatches of one size.

    Attributes:
        features: [B, C * h * w], what `forward` leaves: the last convolution's units in the order
            in which the network's next layers read them. Of the dtype of the factors.
    """

    def __init__(self, network: PreferenceNetwork, batch_size: int, factors: torch.dtype) -> None:
        """Allocates all that a step needs.

        Args:
            network: On the CPU, in the layout that `build_network` gives.
            batch_size: B.
            factors: What is multiplied: float32 or bfloat16.
        """
        self._layers = _layers(network, factors)
        self.features = torch.empty((batch_size, self._layers[-1].n_outputs), dtype=factors)
        sizes = [len(part) for part in torch.split(self.features, _PICTURES_AT_ONCE)]
        products = max(
            POINTS**2 * it.tiling.n_tiles * it.weights.bias.numel() for it in self._layers
        )
        scratch = torch.empty(max(sizes) * products, dtype=factors)
        self._parts = [_Part(self._layers, size, scratch) for size in sizes]

    def forward(self, pictures: Tensor) -> None:
        """Computes the features.

        Args:
            pictures: u8[B, H, W, C].
        """
        for layer in self._layers:
            layer.weights.follow()
        seen, made = (
            torch.split(all_of, _PICTURES_AT_ONCE) for all_of in (pictures, self.features)
        )
        for part, *its_own in zip(self._parts, seen, made, strict=True):
            part.forward(*its_own)

    def backward(self, gradients: Tensor) -> None:
        """Leaves the gradients of the loss at the convolutions' parameters.

        Args:
            gradients: Of the loss by the features, in their shape and dtype.
        """
        for layer in self._layers:
            layer.weights.forget_gradients()
        given = torch.split(gradients, _PICTURES_AT_ONCE)
        for part, its_own in zip(self._parts, given, strict=True):
            part.backward(its_own)
        for layer in self._layers:
            layer.weights.set_gradients()


class _Layer(NamedTuple):
    """A convolution without padding, and the ReLU after it."""

    weights: _Weights
    tiling: Tiling
    inputs: tuple[int, int, int]
    """Rows, columns and channels; those rows and columns included that only tiles reach."""

    @property
    def n_outputs(self) -> int:
        """Numbers that it makes of a picture."""
        return math.prod(self.tiling.outputs) * self.weights.bias.numel()


def _layers(network: PreferenceNetwork, factors: torch.dtype) -> list[_Layer]:
    height, width, channels = network.spec.observation_shape
    layers = []
    for number, convolution in enumerate(network.convolutions):
        assert isinstance(convolution, nn.Conv2d)
        stride = convolution.stride[0]
        reach = convolution.kernel_size[0] // stride
        if number == 0:
            # Three channels or one would be too few for vector instructions.
            height, width, channels = height // stride, width // stride, stride**2 * channels
            stride = 1
        outputs = height // stride + 1 - reach, width // stride + 1 - reach
        size = POINTS + 1 - reach
        tiling = Tiling(size, outputs, -(-outputs[0] // size), -(-outputs[1] // size), stride)
        reached = (
            stride * (n_tiles * size + POINTS - size)
            for n_tiles in (tiling.n_down, tiling.n_across)
        )
        rows, columns = map(max, (height, width), reached)
        layers.append(_Layer(_Weights(convolution, factors), tiling, (rows, columns, channels)))
        (height, width), channels = outputs, convolution.out_channels
    return layers


class _Part:
    """Some pictures of a minibatch on their way through all layers."""

    def __init__(self, layers: list[_Layer], n_pictures: int, scratch: Tensor) -> None:
        rows, columns, channels = layers[0].inputs
        self._blocks = np.zeros((1, rows, columns * channels), np.float32)
        sizes = [it.inputs for it in layers[1:]]
        sizes.append((*layers[-1].tiling.outputs, layers[-1].weights.bias.numel()))
        self._convolutions = [
            _Convolution(layer, n_pictures, size, scratch)
            for layer, size in zip(layers, sizes, strict=True)
        ]

    def forward(self, pictures: Tensor, features: Tensor) -> None:
        """See `WinogradConvolutions.forward`."""
        first, last = self._convolutions[0], self._convolutions[-1]
        pictures_to_points(pictures.numpy(), first.tiling, self._blocks, as_array(first.x))
        for here, following in pairwise(self._convolutions):
            here.multiply()
            units_to_points(*here.units_at_points, following.tiling, as_array(following.x))
        last.multiply()
        units_to_features(*last.units_at_points, as_array(features))

    def backward(self, gradients: Tensor) -> None:
        """See `WinogradConvolutions.backward`; adds to the gradients of the weights."""
        last = self._convolutions[-1]
        feature_gradients_to_points(as_array(gradients), *last.gradients_at_points)
        for here, before in pairwise(reversed(self._convolutions)):
            here.add_weight_gradients()
            here.multiply_back()
            unit_gradients_to_points(as_array(here.x), here.tiling, *before.gradients_at_points)
        self._convolutions[0].add_weight_gradients()


class _Convolution:
    """A layer, for some pictures.

    Attributes:
        tiling: Of its outputs.
        x: [16, T, I], inputs of the tiles at their points; after `multiply_back` their gradients.
    """

    def __init__(
        self, layer: _Layer, n_pictures: int, units: tuple[int, int, int], scratch: Tensor
    ) -> None:
        """Allocates what is kept of the pictures.

        Args:
            layer: Which.
            n_pictures: How many.
            units: Rows, columns and channels of its units, with those that only tiles reach.
            scratch: Memory that all layers and all parts of a minibatch use in turn.
        """
        self._weights, self.tiling = layer.weights, layer.tiling
        _, n_outputs, n_inputs = layer.weights.transformed.shape
        n_tiles = n_pictures * layer.tiling.n_tiles
        self.x = torch.empty((POINTS**2, n_tiles, n_inputs), dtype=scratch.dtype)
        # Outputs of the tiles at their points; in `backward`, gradients.
        self._y = scratch[: POINTS**2 * n_tiles * n_outputs].view(POINTS**2, n_tiles, n_outputs)
        rows, columns, channels = units
        self._units = np.zeros((n_pictures, rows, columns * channels), np.float32)
        self._passed = np.empty((1, *self._units.shape[1:]), np.float32)

    @property
    def units_at_points(self) -> tuple[Factors, Floats, Tiling, Floats]:
        """What its units are made of, and where they go."""
        return as_array(self._y), self._weights.bias.numpy(), self.tiling, self._units

    @property
    def gradients_at_points(self) -> tuple[Floats, Floats, Tiling, Factors, Floats]:
        """Its units, room for a picture's gradients by them, and where these go."""
        bias_gradients = self._weights.bias_gradients.numpy()
        return self._units, self._passed, self.tiling, as_array(self._y), bias_gradients

    def multiply(self) -> None:
        """The products, from the inputs at their points."""
        torch.bmm(self.x, self._weights.transformed.mT, out=self._y)

    def multiply_back(self) -> None:
        """The inputs' gradients at their points, from the outputs'."""
        torch.bmm(self._y, self._weights.transformed, out=self.x)

    def add_weight_gradients(self) -> None:
        """The weights' gradients, from the outputs' at their points."""
        self._weights.add_gradients(self._y, self.x)


class _Weights:
    """A convolution's weights at the points, and where their gradients go.

    Attributes:
        transformed: [16, O, I] of the factors' dtype; I counts all channels of a block of inputs.
        bias: f32[O].
        bias_gradients: f32[O].
    """

    def __init__(self, layer: nn.Conv2d, factors: torch.dtype) -> None:
        assert layer.bias is not None
        n_outputs, channels, kernel, _ = layer.weight.shape
        self._layer, stride = layer, layer.stride[0]
        self._reach = kernel // stride
        self._blocks = n_outputs, self._reach, stride, self._reach, stride * channels
        self._gradients = torch.zeros_like(layer.weight)
        self.transformed = torch.empty((POINTS**2, n_outputs, stride**2 * channels), dtype=factors)
        self._product = torch.empty_like(self.transformed)
        self._sums = torch.empty(self.transformed.shape)
        self._is_first = True
        self.bias = layer.bias.detach()
        self.bias_gradients = torch.zeros_like(self.bias)

    def follow(self) -> None:
        """Follows the parameter."""
        weights = self._by_block(self._layer.weight.detach())
        weights_to_points(weights.numpy(), as_array(self.transformed))

    def forget_gradients(self) -> None:
        """Begins a minibatch."""
        self._is_first = True
        self.bias_gradients.zero_()

    def add_gradients(self, output_gradients: Tensor, inputs: Tensor) -> None:
        """Adds those of some tiles.

        Args:
            output_gradients: [16, T, O], at the points.
            inputs: [16, T, I].
        """
        torch.bmm(output_gradients.mT, inputs, out=self._product)
        if self._is_first:
            self._sums.copy_(self._product)
        else:
            self._sums.add_(self._product)
        self._is_first = False

    def set_gradients(self) -> None:
        """Leaves the sums at the parameters."""
        weight_gradients_from_points(self._sums.numpy(), self._by_block(self._gradients).numpy())
        self._layer.weight.grad, bias = self._gradients, self._layer.bias
        assert bias is not None
        bias.grad = self.bias_gradients

    def _by_block(self, weight: Tensor) -> Tensor:
        """A parameter as [O, r, s, r, s * C] in its own memory, where channels are counted last."""
        return weight.permute(0, 2, 3, 1).view(self._blocks)
