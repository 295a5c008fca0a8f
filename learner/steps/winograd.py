"""The network's convolutions by Winograd's algorithm: the same results by fewer multiplications.

Of the multiplications of a step it leaves about a half; `winograd_kernels` tells how. Those that
are left are matrix products again, 36 at a time, and torch makes them.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from actors.networks import PreferenceNetwork
from learner.steps.winograd_kernels import (
    POINTS,
    Tiling,
    add_input_gradients,
    fold_pictures,
    transform_inputs,
    transform_output_gradients,
    transform_outputs,
    weight_transform,
)


class WinogradConvolutions:
    """All convolutions of a network, for minibatches of one size, in float32."""

    def __init__(self, network: PreferenceNetwork, batch_size: int) -> None:
        """Allocates all that a step needs.

        Args:
            network: On the CPU, in the layout that `build_network` gives.
            batch_size: B.
        """
        layers = [layer for layer in network.convolutions if isinstance(layer, nn.Conv2d)]
        height, width, channels = network.spec.observation_shape
        self._fold = layers[0].stride[0]
        self._run = self._fold * channels
        # Three channels or one would be too few for vector instructions.
        size, channels = (height // self._fold, width // self._fold), self._fold * self._run
        strides = [1, *(layer.stride[0] for layer in layers[1:])]
        tilings = []
        maps = []
        for layer, stride in zip(layers, strides, strict=True):
            reach = layer.kernel_size[0] // layer.stride[0]
            outputs = size[0] // stride + 1 - reach, size[1] // stride + 1 - reach
            tilings.append(_tile(outputs, reach, stride))
            maps.append(_Maps(batch_size, size, channels, _room(size, tilings[-1])))
            size, channels = outputs, layer.out_channels
        maps.append(_Maps(batch_size, size, channels, size))
        self._maps = maps
        self._layers = [
            _Convolution(*parts) for parts in zip(layers, tilings, maps, maps[1:], strict=False)
        ]

    @property
    def maps(self) -> Tensor:
        """See `learner.steps.product_steps.Convolutions`."""
        return self._maps[-1].by_channel(self._maps[-1].values)

    def forward(self, pictures: Tensor) -> None:
        """See `learner.steps.product_steps.Convolutions`."""
        folded = self._maps[0].values.numpy()
        fold_pictures(pictures.flatten(2).numpy(), self._fold, self._run, folded)
        for layer in self._layers:
            layer.forward()

    def backward(self, gradients: Tensor) -> None:
        """See `learner.steps.product_steps.Convolutions`."""
        last = self._maps[-1]
        last.by_channel(last.gradients).copy_(gradients)
        for layer in reversed(self._layers[1:]):
            layer.backward()
            layer.give_input_gradients()
        self._layers[0].backward()


def _tile(outputs: tuple[int, int], reach: int, stride: int) -> Tiling:
    size = POINTS + 1 - reach
    return Tiling(size, -(-outputs[0] // size), -(-outputs[1] // size), stride)


def _room(size: tuple[int, int], tiling: Tiling) -> tuple[int, int]:
    """Rows and columns of inputs, those included that tiles reach and pictures do not."""
    beyond = POINTS - tiling.size
    return (
        max(size[0], tiling.stride * (tiling.n_down * tiling.size + beyond)),
        max(size[1], tiling.stride * (tiling.n_across * tiling.size + beyond)),
    )


class _Maps:
    """What lies between two layers.

    Attributes:
        size: Rows and columns that there are.
        values: f32[B, >= rows, >= columns * C], zero beyond the size.
        gradients: Of the loss by the values.
    """

    def __init__(
        self, batch_size: int, size: tuple[int, int], channels: int, room: tuple[int, int]
    ) -> None:
        self.size = size
        self._channels = channels
        self.values = torch.zeros((batch_size, room[0], room[1] * channels))
        self.gradients = torch.zeros_like(self.values)

    def by_channel(self, values: Tensor) -> Tensor:
        """A view [B, rows, columns, C] of the values or the gradients."""
        batch_size, rows, _ = values.shape
        by_channel = values.view(batch_size, rows, -1, self._channels)
        return by_channel[:, : self.size[0], : self.size[1]]


class _Convolution:
    """A convolution without padding, and the ReLU after it."""

    def __init__(self, layer: nn.Conv2d, tiling: Tiling, inputs: _Maps, outputs: _Maps) -> None:
        self._weights = _Weights(layer)
        self._tiling, self._inputs, self._outputs = tiling, inputs, outputs
        n_tiles = len(inputs.values) * tiling.n_down * tiling.n_across
        _, n_outputs, n_inputs = self._weights.transformed.shape
        # Of the inputs and the outputs of a tile at its points, and their gradients.
        self._x = torch.empty((POINTS**2, n_tiles, n_inputs))
        self._y = torch.empty((POINTS**2, n_tiles, n_outputs))
        self._x_gradients, self._y_gradients = torch.empty_like(self._x), torch.empty_like(self._y)

    def forward(self) -> None:
        """Gives the outputs' values from those of the inputs."""
        self._weights.follow()
        transform_inputs(self._inputs.values.numpy(), self._tiling, self._x.numpy())
        torch.bmm(self._x, self._weights.transformed.mT, out=self._y)
        transform_outputs(
            self._y.numpy(),
            self._weights.bias.numpy(),
            self._tiling,
            self._outputs.size,
            self._outputs.values.numpy(),
        )

    def backward(self) -> None:
        """Leaves the parameters' gradients, given those of the outputs."""
        transform_output_gradients(
            self._outputs.gradients.numpy(),
            self._outputs.values.numpy(),
            self._tiling,
            self._outputs.size,
            self._y_gradients.numpy(),
            self._weights.bias_gradients.numpy(),
        )
        torch.bmm(self._y_gradients.mT, self._x, out=self._weights.transformed_gradients)
        self._weights.set_gradients()

    def give_input_gradients(self) -> None:
        """Gives the inputs' gradients; `backward` was before."""
        torch.bmm(self._y_gradients, self._weights.transformed, out=self._x_gradients)
        add_input_gradients(self._x_gradients.numpy(), self._tiling, self._inputs.gradients.numpy())


class _Weights:
    """A convolution's weights at the points, and where their gradients go.

    Attributes:
        transformed: f32[36, O, I], I counts all channels of a block of inputs.
        transformed_gradients: The same shape.
        bias: f32[O].
        bias_gradients: f32[O].
    """

    def __init__(self, layer: nn.Conv2d) -> None:
        assert layer.bias is not None
        n_outputs, channels, kernel, _ = layer.weight.shape
        self._layer, stride = layer, layer.stride[0]
        self._reach = kernel // stride
        self._matrix = torch.from_numpy(weight_transform(self._reach))
        # By rows and columns of blocks, as the parameter lies in memory.
        self._blocks = (n_outputs, self._reach, stride, self._reach, stride, channels)
        self._plain = torch.empty((self._reach, self._reach, n_outputs, stride, stride, channels))
        self._gradients = torch.zeros_like(layer.weight)
        self.transformed = torch.empty((POINTS**2, n_outputs, stride * stride * channels))
        self.transformed_gradients = torch.empty_like(self.transformed)
        self.bias = layer.bias.detach()
        self.bias_gradients = torch.zeros_like(self.bias)

    def follow(self) -> None:
        """Follows the parameter."""
        self._plain.copy_(self._view(self._layer.weight.detach()))
        torch.mm(
            self._matrix, self._plain.flatten(2).flatten(0, 1), out=self.transformed.flatten(1)
        )

    def set_gradients(self) -> None:
        """Leaves the gradients at the parameters."""
        flat = self._plain.flatten(2).flatten(0, 1)
        torch.mm(self._matrix.t(), self.transformed_gradients.flatten(1), out=flat)
        self._view(self._gradients).copy_(self._plain)
        self._layer.weight.grad, bias = self._gradients, self._layer.bias
        assert bias is not None
        bias.grad = self.bias_gradients

    def _view(self, weight: Tensor) -> Tensor:
        """A parameter as [r, r, O, s, s, C] in its own memory, where channels are counted last."""
        return weight.permute(0, 2, 3, 1).view(self._blocks).permute(1, 3, 0, 2, 4, 5)
