"""A layer's parameters as the matrices that products need, and the products themselves."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learner.steps.patch_kernels import sum_rows


class WeightMatrix:
    """A layer's weights as a matrix, and where their gradients go.

    With float32 products read the parameters themselves. With bfloat16 they are scaled and rounded
    before each product, and the gradients' sums are float32.

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
        self._is_exact = dtype == torch.float32
        if self._is_exact:
            assert scale == 1.0, "what is scaled is not the parameter itself"
            self.rounded, self.bias = self._matrix(self._weight), self._bias.detach()
        else:
            self.rounded = torch.empty(shape, dtype=dtype)
            self.bias = torch.empty_like(self._bias, dtype=dtype)
            # Kept, since fresh pages of its size take longer than the product.
            self._product = torch.empty_like(self.rounded)

    def refresh(self) -> None:
        """Follows the parameters, where the products do not read them directly."""
        if self._is_exact:
            return
        if self._scale == 1.0:
            self.rounded.copy_(self._matrix(self._weight))  # several times as fast as `mul`
        else:
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
        if self._is_exact:
            torch.mm(output_gradients.t(), inputs, out=matrix)
            torch.sum(output_gradients, 0, out=bias)
        else:
            matrix.copy_(torch.mm(output_gradients.t(), inputs, out=self._product))
            if self._scale != 1.0:
                matrix.mul_(self._scale)
            sum_rows(output_gradients.view(torch.uint16).numpy(), bias.numpy())
        self._weight.grad, self._bias.grad = weight, bias

    def _matrix(self, weight: Tensor) -> Tensor:
        """A weight as [O, I] in its own memory; of a convolution, I counts channels fastest."""
        plain = weight.detach()
        return (plain.permute(0, 2, 3, 1) if plain.dim() == 4 else plain).view(self._shape)


def forward_with_relu(inputs: Tensor, weights: WeightMatrix, outputs: Tensor) -> None:
    """max(0, x W' + b) of inputs [n, I], into outputs [n, O]."""
    weights.refresh()
    torch.addmm(weights.bias, inputs, weights.rounded.t(), out=outputs)
    outputs.relu_()


def pass_relu(gradients: Tensor, outputs: Tensor) -> None:
    """Sets the gradients to 0 where the ReLU did."""
    torch.ops.aten.threshold_backward.grad_input(gradients, outputs, 0.0, grad_input=gradients)
