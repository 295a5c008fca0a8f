"""The network's convolutions as one matrix product forwards and two backwards each, in bfloat16.

The patches of a layer's inputs are the rows of a matrix. Weights and activations are rounded before
each product. On a processor that has products of bfloat16 nothing is faster.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from actors.networks import PreferenceNetwork
from learner.steps.patch_kernels import WORD, add_patches, take_patches
from learner.steps.weight_matrix import WeightMatrix, forward_with_relu, pass_relu


class PatchConvolutions:
    """All convolutions of a network, for minibatches of one size."""

    def __init__(self, network: PreferenceNetwork, batch_size: int) -> None:
        """Allocates all that a step needs.

        Args:
            network: On the CPU, in the layout that `build_network` gives.
            batch_size: B.
        """
        height, width, channels = network.spec.observation_shape
        self._width = width
        # Lines are whole words; no patch reaches what is added.
        lines = batch_size, height, -(-width // WORD) * WORD, channels
        self._pixels = torch.zeros(lines, dtype=torch.bfloat16)
        self._convolutions: list[_Convolution] = []
        inputs, size = self._pixels, (height, width)
        for number, layer in enumerate(network.convolutions):
            assert isinstance(layer, nn.Conv2d)
            # Whole numbers up to 255 are exact in bfloat16, 255ths of them are not.
            scale = 1.0 / 255.0 if number == 0 else 1.0
            self._convolutions.append(_Convolution(layer, inputs, size, scale))
            inputs = self._convolutions[-1].outputs
            size = (inputs.shape[1], inputs.shape[2])

    @property
    def maps(self) -> Tensor:
        """See `learner.steps.product_steps.Convolutions`."""
        return self._convolutions[-1].outputs

    def forward(self, pictures: Tensor) -> None:
        """See `learner.steps.product_steps.Convolutions`."""
        self._pixels[:, :, : self._width].copy_(pictures)
        for convolution in self._convolutions:
            convolution.forward()

    def backward(self, gradients: Tensor) -> None:
        """See `learner.steps.product_steps.Convolutions`."""
        last = self._convolutions[-1]
        last.gradients.copy_(gradients)
        pass_relu(last.gradients, last.outputs)
        for convolution, below in zip(
            self._convolutions[:0:-1], self._convolutions[-2::-1], strict=True
        ):
            convolution.backward()
            convolution.give_input_gradients(below.gradients)
        self._convolutions[0].backward()


class _Convolution:
    """A convolution without padding, and the ReLU after it.

    Attributes:
        outputs: bf16[B, h, w, O].
        gradients: Of the loss by the sums that the ReLU was given, the same shape.
    """

    def __init__(
        self, layer: nn.Conv2d, inputs: Tensor, size: tuple[int, int], scale: float
    ) -> None:
        channels = inputs.shape[-1]
        self._kernel, self._stride = layer.kernel_size[0], layer.stride[0]
        self._size = tuple((each - self._kernel) // self._stride + 1 for each in size)
        self._inputs = inputs
        self._step = self._stride * channels
        assert self._step % WORD == 0, "a layer's strides times channels are whole words"
        n_inputs = self._kernel * self._kernel * channels
        maps = (len(inputs), *self._size, layer.out_channels)
        self.outputs = inputs.new_empty(maps)
        self.gradients = inputs.new_empty(maps)
        self._patches = inputs.new_empty((self.outputs[..., 0].numel(), n_inputs))
        self._patch_gradients = torch.empty_like(self._patches)
        self._weights = WeightMatrix(layer, (layer.out_channels, n_inputs), inputs.dtype, scale)

    def forward(self) -> None:
        """Gives the outputs from the inputs."""
        words = self._inputs.flatten(2).view(torch.int64).numpy()
        steps = self._stride, self._step // WORD
        patches = self._patches.view(torch.int64).numpy()
        take_patches(words, self._size, self._kernel, steps, patches)
        forward_with_relu(self._patches, self._weights, self.outputs.view(len(self._patches), -1))

    def backward(self) -> None:
        """Leaves the parameters' gradients, given those of the outputs."""
        self._weights.set_gradients(self._by_patch(self.gradients), self._patches)

    def give_input_gradients(self, gradients: Tensor) -> None:
        """Gives the gradients of the sums whose ReLU the inputs are, in their shape."""
        torch.mm(self._by_patch(self.gradients), self._weights.rounded, out=self._patch_gradients)
        add_patches(
            _bits(self._patch_gradients),
            self._size,
            self._kernel,
            (self._stride, self._step),
            _bits(self._inputs.flatten(2)),
            _bits(gradients.flatten(2)),
        )

    def _by_patch(self, maps: Tensor) -> Tensor:
        return maps.view(len(self._patches), -1)


def _bits(numbers: Tensor) -> NDArray[np.uint16]:
    return numbers.view(torch.uint16).numpy()
