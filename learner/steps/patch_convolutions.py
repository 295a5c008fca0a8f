"""The network's convolutions as one matrix product forwards and two backwards each.

The patches of a layer's inputs are the rows of a matrix. With bfloat16, on a processor that has
products of it, nothing is faster; weights and activations are rounded before each product.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from actors.networks import PreferenceNetwork
from learner.steps.weight_matrix import WeightMatrix, forward_with_relu, pass_relu


class PatchConvolutions:
    """All convolutions of a network, for minibatches of one size."""

    def __init__(self, network: PreferenceNetwork, batch_size: int, dtype: torch.dtype) -> None:
        """Allocates all that a step needs.

        Args:
            network: On the CPU, in the layout that `build_network` gives.
            batch_size: B.
            dtype: Of the products, float32 or bfloat16.
        """
        height, width, channels = network.spec.observation_shape
        self._pixels = torch.empty((batch_size, height, width, channels), dtype=dtype)
        self._convolutions: list[_Convolution] = []
        inputs = self._pixels
        for number, layer in enumerate(network.convolutions):
            assert isinstance(layer, nn.Conv2d)
            # Whole numbers up to 255 are exact in bfloat16, 255ths of them are not.
            scale = 1.0 / 255.0 if number == 0 else 1.0
            self._convolutions.append(_Convolution(layer, inputs, scale))
            inputs = self._convolutions[-1].outputs

    @property
    def maps(self) -> Tensor:
        """See `learner.steps.product_steps.Convolutions`."""
        return self._convolutions[-1].outputs

    def forward(self, pictures: Tensor) -> None:
        """See `learner.steps.product_steps.Convolutions`."""
        self._pixels.copy_(pictures)
        for convolution in self._convolutions:
            convolution.forward()

    def backward(self, gradients: Tensor) -> None:
        """See `learner.steps.product_steps.Convolutions`."""
        self._convolutions[-1].gradients.copy_(gradients)
        for convolution, below in zip(
            reversed(self._convolutions), [*reversed(self._convolutions[:-1]), None], strict=True
        ):
            convolution.backward(None if below is None else below.gradients)


class _Convolution:
    """A convolution without padding, and the ReLU after it.

    Attributes:
        outputs: [B, h, w, O].
        gradients: Of the loss by the outputs, the same shape.
    """

    def __init__(self, layer: nn.Conv2d, inputs: Tensor, scale: float) -> None:
        batch_size, height, width, channels = inputs.shape
        (kernel, _), (stride, _) = layer.kernel_size, layer.stride
        rows, columns = (height - kernel) // stride + 1, (width - kernel) // stride + 1
        line = width * channels
        # A line of a patch is contiguous in a picture whose channels come last.
        self._windows = inputs.as_strided(
            (batch_size, rows, columns, kernel, kernel * channels),
            (height * line, stride * line, stride * channels, line, 1),
        )
        n_outputs, n_inputs = layer.out_channels, kernel * kernel * channels
        self._patches = inputs.new_empty((batch_size * rows * columns, n_inputs))
        self._patch_gradients = torch.empty_like(self._patches)
        self._weights = WeightMatrix(layer, (n_outputs, n_inputs), inputs.dtype, scale)
        self.outputs = inputs.new_empty((batch_size, rows, columns, n_outputs))
        self.gradients = torch.empty_like(self.outputs)
        self._geometry = kernel, stride, line, channels

    def forward(self) -> None:
        self._patches.view(self._windows.shape).copy_(self._windows)
        forward_with_relu(self._patches, self._weights, self.outputs.view(len(self._patches), -1))

    def backward(self, input_gradients: Tensor | None) -> None:
        """Leaves the parameters' gradients, and those of the inputs where they are wanted."""
        gradients = self.gradients.view(len(self._patches), -1)
        pass_relu(gradients, self.outputs.view(gradients.shape))
        self._weights.set_gradients(gradients, self._patches)
        if input_gradients is not None:
            torch.mm(gradients, self._weights.rounded, out=self._patch_gradients)
            self._add_patches(input_gradients)

    def _add_patches(self, inputs: Tensor) -> None:
        """Adds every patch's gradients to the inputs that it was taken from."""
        kernel, stride, line, channels = self._geometry
        batch_size, rows, columns, _ = self.outputs.shape
        # Patches of neighbours are `stride` columns apart: so much of a line never overlaps.
        run = stride * channels
        parts = self._patch_gradients.view(batch_size, rows, columns, kernel, -1, run)
        inputs.zero_()
        for row in range(kernel):
            for part in range(parts.shape[4]):
                inputs.as_strided(
                    (batch_size, rows, columns, run),
                    (inputs.stride(0), stride * line, run, 1),
                    row * line + part * run,
                ).add_(parts[:, :, :, row, part])
