"""The gradient steps on a CPU, written as matrix products into buffers that are kept.

Here a layer is one product forwards and two backwards: patches of its input, weights and gradients
are matrices, the latter in the memory of the network's own parameters, and hardly anything is
allocated or reordered in a step. Only the head, which is small and has three forms, is left to
autograd, in float32.

With bfloat16, weights and activations are rounded before each product, sums are float32 inside it,
and parameters, head, teaching signals and the optimiser's state stay float32.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from actors.networks import PreferenceNetwork
from learner.memory import LocalMemory
from learner.optimiser import FusedAdam


class ProductSteps:
    """Makes the steps by matrix products; equals `EagerSteps` up to rounding."""

    def __init__(
        self,
        network: PreferenceNetwork,
        optimiser: FusedAdam,
        memory: LocalMemory,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """Prepares nothing yet: buffers are made when a minibatch size is met.

        Args:
            network: On the CPU, in the layout that `build_network` gives.
            optimiser: From `build_optimiser`, for the network.
            memory: Gives pictures and actions.
            dtype: Of the products, float32 or bfloat16.
        """
        self._network = network
        self._optimiser = optimiser
        self._memory = memory
        self._dtype = dtype
        self._trunk: _Trunk | None = None

    def run(self, batches: Tensor, targets: Tensor) -> Tensor:
        """See `GradientSteps.run`."""
        batch_size = batches.shape[1]
        # One size at a time: a memory that is smaller than a minibatch has another at each update.
        if self._trunk is None or self._trunk.batch_size != batch_size:
            self._trunk = _Trunk(self._network, batch_size, self._dtype)
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


class _Trunk:
    """All layers below the head, for minibatches of one size."""

    def __init__(self, network: PreferenceNetwork, batch_size: int, dtype: torch.dtype) -> None:
        height, width, channels = network.spec.observation_shape
        self.batch_size = batch_size
        self._pixels = torch.empty((batch_size, height, width, channels), dtype=dtype)
        self._convolutions: list[_Convolution] = []
        inputs = self._pixels
        for number, layer in enumerate(network.convolutions):
            assert isinstance(layer, nn.Conv2d)
            # Whole numbers up to 255 are exact in bfloat16, 255ths of them are not.
            scale = 1.0 / 255.0 if number == 0 else 1.0
            self._convolutions.append(_Convolution(layer, inputs, scale))
            inputs = self._convolutions[-1].outputs
        # The network's features are ordered by channel first.
        self._features = torch.empty((batch_size, inputs[0].numel()), dtype=dtype)
        self._feature_gradients = torch.empty_like(self._features)
        self._hidden = [_Hidden(layer, self._features) for layer in network.hidden_layers]

    def forward(self, pictures: Tensor) -> list[Tensor]:
        """Hidden units f32[B, 512] of each stream, as leaves of the head's graph.

        Args:
            pictures: u8[B, H, W, C].
        """
        self._pixels.copy_(pictures)
        with torch.no_grad():
            for convolution in self._convolutions:
                convolution.forward()
            maps = self._convolutions[-1].outputs
            self._by_channel(self._features, maps).copy_(maps)
            units = [layer.forward() for layer in self._hidden]
        return [each.to(torch.float32, copy=True).requires_grad_() for each in units]

    @torch.no_grad()
    def backward(self, unit_gradients: list[Tensor | None]) -> None:
        """Leaves the gradients of the loss at the layers' parameters."""
        for number, (layer, gradients) in enumerate(zip(self._hidden, unit_gradients, strict=True)):
            assert gradients is not None
            layer.backward(gradients, self._feature_gradients, accumulate=number > 0)
        last = self._convolutions[-1]
        last.gradients.copy_(self._by_channel(self._feature_gradients, last.outputs))
        for convolution, below in zip(
            reversed(self._convolutions), [*reversed(self._convolutions[:-1]), None], strict=True
        ):
            convolution.backward(None if below is None else below.gradients)

    @staticmethod
    def _by_channel(features: Tensor, maps: Tensor) -> Tensor:
        """A view of features [B, C * H * W] with the axes of maps [B, H, W, C]."""
        batch_size, height, width, channels = maps.shape
        return features.view(batch_size, channels, height, width).permute(0, 2, 3, 1)


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
        self._weights = _Weights(layer, (n_outputs, n_inputs), inputs.dtype, scale)
        self.outputs = inputs.new_empty((batch_size, rows, columns, n_outputs))
        self.gradients = torch.empty_like(self.outputs)
        self._geometry = kernel, stride, line, channels

    def forward(self) -> None:
        self._patches.view(self._windows.shape).copy_(self._windows)
        _forward(self._patches, self._weights, self.outputs.view(len(self._patches), -1))

    def backward(self, input_gradients: Tensor | None) -> None:
        """Leaves the parameters' gradients, and those of the inputs where they are wanted."""
        gradients = self.gradients.view(len(self._patches), -1)
        _pass_relu(gradients, self.outputs.view(gradients.shape))
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


class _Hidden:
    """A fully connected layer on the features, and the ReLU after it."""

    def __init__(self, layer: nn.Linear, features: Tensor) -> None:
        self._features = features
        self._weights = _Weights(layer, tuple(layer.weight.shape), features.dtype, 1.0)
        self._units = features.new_empty((len(features), layer.out_features))
        self._gradients = torch.empty_like(self._units)

    def forward(self) -> Tensor:
        _forward(self._features, self._weights, self._units)
        return self._units

    def backward(self, gradients: Tensor, feature_gradients: Tensor, *, accumulate: bool) -> None:
        self._gradients.copy_(gradients)
        _pass_relu(self._gradients, self._units)
        self._weights.set_gradients(self._gradients, self._features)
        if accumulate:
            feature_gradients.addmm_(self._gradients, self._weights.rounded)
        else:
            torch.mm(self._gradients, self._weights.rounded, out=feature_gradients)


class _Weights:
    """A layer's weights as a matrix, and where their gradients go.

    Attributes:
        rounded: What the products use, [O, I]: the weights times the scale of the inputs.
        bias: [O].
    """

    def __init__(
        self, layer: nn.Conv2d | nn.Linear, shape: tuple[int, ...], dtype: torch.dtype, scale: float
    ) -> None:
        assert layer.bias is not None
        self._weight, self._bias = layer.weight, layer.bias
        self._gradients = torch.zeros_like(layer.weight), torch.zeros_like(layer.bias)
        self._shape = shape
        self._scale = scale
        is_exact = dtype == torch.float32 and scale == 1.0
        self.rounded = self._matrix(self._weight) if is_exact else torch.empty(shape, dtype=dtype)
        self.bias = self._bias.detach() if is_exact else torch.empty_like(self._bias, dtype=dtype)
        self._is_exact = is_exact

    def refresh(self) -> None:
        """Follows the parameters, where the products do not read them directly."""
        if not self._is_exact:
            torch.mul(self._matrix(self._weight), self._scale, out=self.rounded)
            self.bias.copy_(self._bias)

    def set_gradients(self, output_gradients: Tensor, inputs: Tensor) -> None:
        """Leaves the gradients at the parameters.

        Args:
            output_gradients: [n, O].
            inputs: [n, I], before the scale.
        """
        weight, bias = self._gradients
        matrix = self._matrix(weight)
        if output_gradients.dtype == torch.float32:
            torch.mm(output_gradients.t(), inputs, out=matrix)
        else:
            matrix.copy_(torch.mm(output_gradients.t(), inputs))
        if self._scale != 1.0:
            matrix.mul_(self._scale)
        torch.sum(output_gradients, 0, dtype=torch.float32, out=bias)
        self._weight.grad, self._bias.grad = weight, bias

    def _matrix(self, weight: Tensor) -> Tensor:
        """A weight as [O, I] in its own memory; of a convolution, I counts channels fastest."""
        plain = weight.detach()
        return (plain.permute(0, 2, 3, 1) if plain.dim() == 4 else plain).view(self._shape)


def _forward(inputs: Tensor, weights: _Weights, outputs: Tensor) -> None:
    weights.refresh()
    torch.addmm(weights.bias, inputs, weights.rounded.t(), out=outputs)
    outputs.relu_()


def _pass_relu(gradients: Tensor, outputs: Tensor) -> None:
    """Sets the gradients to 0 where the ReLU did."""
    torch.ops.aten.threshold_backward.grad_input(gradients, outputs, 0.0, grad_input=gradients)
