"""Patches by the compiled loops against torch's own unfold and fold."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from learner.steps.patch_kernels import WORD, add_patches, sum_rows, take_patches

B = 3
LAYERS = [(20, 26, 4, 8, 4), (20, 20, 32, 4, 2), (9, 7, 64, 3, 1), (11, 13, 4, 4, 2)]
"""Height, width, channels, kernel and stride: as in the network, and one that leaves a rest."""


def patches_in(pictures: Tensor, kernel: int, stride: int) -> Tensor:
    """f32[B * rows * columns, kernel * kernel * C] of f32[B, H, W, C], by torch."""
    channels = pictures.shape[-1]
    columns = functional.unfold(pictures.permute(0, 3, 1, 2), kernel, stride=stride)
    by_place = columns.view(B, channels, kernel, kernel, -1).permute(0, 4, 2, 3, 1)
    return by_place.reshape(-1, kernel * kernel * channels)


def random_pictures(height: int, width: int, channels: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randn((B, height, width, channels), generator=generator).to(torch.bfloat16)


def patches_of(height: int, width: int, kernel: int, stride: int) -> tuple[int, int]:
    return (height - kernel) // stride + 1, (width - kernel) // stride + 1


@pytest.mark.parametrize(("height", "width", "channels", "kernel", "stride"), LAYERS)
def test_patches_are_those_of_torch(
    height: int, width: int, channels: int, kernel: int, stride: int
) -> None:
    pictures = random_pictures(height, width, channels)
    expected = patches_in(pictures.float(), kernel, stride)
    got = torch.full(expected.shape, torch.nan).to(torch.bfloat16)
    lines = pictures.flatten(2).view(torch.int64).numpy()
    size, steps = patches_of(height, width, kernel, stride), (stride, stride * channels // WORD)
    take_patches(lines, size, kernel, steps, got.view(torch.int64).numpy())
    assert torch.equal(got.float(), expected)


@pytest.mark.parametrize(("height", "width", "channels", "kernel", "stride"), LAYERS)
def test_gradients_are_the_sums_of_torch_rounded_once_and_stopped_by_the_relu(
    height: int, width: int, channels: int, kernel: int, stride: int
) -> None:
    units = random_pictures(height, width, channels).relu()
    inputs = torch.zeros((B, height, width, channels), requires_grad=True)
    patches = patches_in(inputs, kernel, stride)
    given = torch.randn(patches.shape, generator=torch.Generator().manual_seed(1))
    given = given.to(torch.bfloat16)
    patches.backward(given.float())  # type: ignore[no-untyped-call]
    got = torch.full_like(units, torch.nan)
    add_patches(
        given.view(torch.uint16).numpy(),
        patches_of(height, width, kernel, stride),
        kernel,
        (stride, stride * channels),
        units.flatten(2).view(torch.uint16).numpy(),
        got.flatten(2).view(torch.uint16).numpy(),
    )
    assert inputs.grad is not None
    expected = (inputs.grad * (units > 0)).to(torch.bfloat16)
    # Sums in another order may fall to the other side of a rounding.
    torch.testing.assert_close(got, expected, rtol=2**-8, atol=1e-6)
    assert (got == expected).float().mean() > 0.999


@pytest.mark.parametrize("n_rows", [1, 4, 10])
def test_sums_of_rows_are_those_of_torch(n_rows: int) -> None:
    rows = random_pictures(n_rows, 1, 33)[0, :, 0]
    sums = torch.full((33,), torch.nan)
    sum_rows(rows.view(torch.uint16).numpy(), sums.numpy())
    torch.testing.assert_close(sums, rows.float().sum(0))
