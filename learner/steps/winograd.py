"""The network's convolutions by Winograd's algorithm: the same results by fewer multiplications.

Of the multiplications of a step it leaves about a half; `winograd_kernels` tells how. Those that
are left are matrix products again, 16 at a time, and torch makes them: of float32, or of factors
that are rounded to bfloat16 right before. A few pictures at a time go through all layers, so that
what one leaves is still near the processor when the next one reads it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from actors.networks import PreferenceNetwork
from learner.steps.factors import as_array
from learner.steps.winograd_kernels import (
    POINTS,
    Tiling,
    add_input_gradients,
    fold_pictures,
    maps_from_features,
    maps_to_features,
    transform_inputs,
    transform_output_gradients,
    transform_outputs,
    transform_weight_gradients,
    transform_weights,
)

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
        scratch = _Scratch(self._layers, max(sizes), factors)
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


class _Scratch:
    """Memory that all layers and all parts of a minibatch use in turn."""

    def __init__(self, layers: list[_Layer], n_pictures: int, factors: torch.dtype) -> None:
        products = max(
            POINTS**2 * it.tiling.n_down * it.tiling.n_across * it.weights.bias.numel()
            for it in layers
        )
        maps = max(max(math.prod(it.inputs), it.n_outputs) for it in layers)
        self._products = torch.empty(n_pictures * products, dtype=factors)
        self._gradients = torch.empty(n_pictures * maps)

    def products(self, *shape: int) -> Tensor:
        """For the outputs of tiles at their points, and then for their gradients."""
        return self._products[: math.prod(shape)].view(shape)

    def gradients(self, shape: torch.Size) -> Tensor:
        """For those by what lies between two layers; each layer takes some and leaves some."""
        return self._gradients[: shape.numel()].view(shape)


class _Maps:
    """What lies between two layers.

    Attributes:
        values: f32[b, rows, columns * C], zero where only tiles reach.
        gradients: Of the loss by the values, in scratch memory.
        n_channels: C.
    """

    def __init__(self, n_pictures: int, size: tuple[int, int, int], scratch: _Scratch) -> None:
        rows, columns, self.n_channels = size
        values = torch.zeros((n_pictures, rows, columns * self.n_channels))
        self.values = values.numpy()
        self.gradients = scratch.gradients(values.shape).numpy()


class _Part:
    """Some pictures of a minibatch on their way through all layers."""

    def __init__(self, layers: list[_Layer], n_pictures: int, scratch: _Scratch) -> None:
        last = layers[-1]
        sizes = [it.inputs for it in layers]
        sizes.append((*last.tiling.outputs, last.weights.bias.numel()))
        maps = [_Maps(n_pictures, size, scratch) for size in sizes]
        self._first, self._last = maps[0], maps[-1]
        self._convolutions = [
            _Convolution(layer, inputs, outputs, scratch)
            for layer, inputs, outputs in zip(layers, maps, maps[1:], strict=False)
        ]

    def forward(self, pictures: Tensor, features: Tensor) -> None:
        """See `WinogradConvolutions.forward`."""
        fold_pictures(pictures.numpy(), self._first.n_channels, self._first.values)
        for convolution in self._convolutions:
            convolution.forward()
        maps_to_features(self._last.values, self._last.n_channels, as_array(features))

    def backward(self, gradients: Tensor) -> None:
        """See `WinogradConvolutions.backward`; adds to the gradients of the weights."""
        maps_from_features(as_array(gradients), self._last.n_channels, self._last.gradients)
        for convolution in reversed(self._convolutions[1:]):
            convolution.backward()
            convolution.give_input_gradients()
        self._convolutions[0].backward()


class _Convolution:
    """A layer, for some pictures."""

    def __init__(self, layer: _Layer, inputs: _Maps, outputs: _Maps, scratch: _Scratch) -> None:
        self._weights, self._tiling = layer.weights, layer.tiling
        self._inputs, self._outputs = inputs, outputs
        _, n_outputs, n_inputs = layer.weights.transformed.shape
        n_tiles = len(inputs.values) * layer.tiling.n_down * layer.tiling.n_across
        # Inputs and outputs of the tiles at their points; in `backward`, gradients.
        factors = layer.weights.transformed.dtype
        self._x = torch.empty((POINTS**2, n_tiles, n_inputs), dtype=factors)
        self._y = scratch.products(POINTS**2, n_tiles, n_outputs)
        self._plain_x, self._plain_y = as_array(self._x), as_array(self._y)

    def forward(self) -> None:
        """Gives the outputs' values from those of the inputs."""
        transform_inputs(self._inputs.values, self._tiling, self._plain_x)
        torch.bmm(self._x, self._weights.transformed.mT, out=self._y)
        bias = self._weights.bias.numpy()
        transform_outputs(self._plain_y, bias, self._tiling, self._outputs.values)

    def backward(self) -> None:
        """Adds to the parameters' gradients, given those of the outputs."""
        transform_output_gradients(
            self._outputs.gradients,
            self._outputs.values,
            self._tiling,
            self._plain_y,
            self._weights.bias_gradients.numpy(),
        )
        self._weights.add_gradients(self._y, self._x)

    def give_input_gradients(self) -> None:
        """Gives the inputs' gradients; `backward` was before."""
        torch.bmm(self._y, self._weights.transformed, out=self._x)
        add_input_gradients(self._plain_x, self._tiling, self._inputs.gradients)


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
        self.bias = layer.bias.detach()
        self.bias_gradients = torch.zeros_like(self.bias)

    def follow(self) -> None:
        """Follows the parameter."""
        weights = self._by_block(self._layer.weight.detach())
        transform_weights(weights.numpy(), as_array(self.transformed))

    def forget_gradients(self) -> None:
        """Begins a minibatch."""
        self._sums.zero_()
        self.bias_gradients.zero_()

    def add_gradients(self, output_gradients: Tensor, inputs: Tensor) -> None:
        """Adds those of some tiles.

        Args:
            output_gradients: [16, T, O], at the points.
            inputs: [16, T, I].
        """
        torch.bmm(output_gradients.mT, inputs, out=self._product)
        self._sums.add_(self._product)

    def set_gradients(self) -> None:
        """Leaves the sums at the parameters."""
        transform_weight_gradients(self._sums.numpy(), self._by_block(self._gradients).numpy())
        self._layer.weight.grad, bias = self._gradients, self._layer.bias
        assert bias is not None
        bias.grad = self.bias_gradients

    def _by_block(self, weight: Tensor) -> Tensor:
        """A parameter as [O, r, s, r, s * C] in its own memory, where channels are counted last."""
        return weight.permute(0, 2, 3, 1).view(self._blocks)
