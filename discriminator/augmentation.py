"""Changes of pictures that nothing must be told from.

Discriminators see them on real and generated pictures alike; without the shift, imitation from
pictures was unstable in trials. Behaviour cloning may have them too.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from broker_config.preset import DiscriminatorPreset


def random_turn(pictures: Tensor, most_deg: float, generator: torch.Generator) -> Tensor:
    """Each picture turned about its centre by up to so many degrees, its border repeated.

    Args:
        pictures: f32[B, C, H, W].
        most_deg: In either direction; 0 changes nothing.
        generator: On the CPU; draws the angles.
    """
    if most_deg == 0.0:
        return pictures
    height, width = pictures.shape[2:]
    drawn = torch.rand(len(pictures), generator=generator)
    angles = torch.deg2rad(most_deg * (2.0 * drawn - 1.0)).to(pictures.device)
    cosines, sines, zeros = angles.cos(), angles.sin(), torch.zeros_like(angles)
    # Coordinates run from -1 to 1 along either axis: the ratio keeps turned squares square.
    ratio = height / width
    rows = (cosines, -sines * ratio, zeros), (sines / ratio, cosines, zeros)
    maps = torch.stack([torch.stack(row, 1) for row in rows], 1)
    places = functional.affine_grid(maps, list(pictures.shape), align_corners=False)
    return functional.grid_sample(
        pictures, places, mode="bilinear", padding_mode="border", align_corners=False
    )


def random_shift(pictures: Tensor, most_px: int, generator: torch.Generator) -> Tensor:
    """Each picture shifted by up to so many pixels, its border repeated.

    Args:
        pictures: f32[B, C, H, W].
        most_px: In either direction; 0 changes nothing.
        generator: On the CPU; draws the shifts.
    """
    if most_px == 0:
        return pictures
    batch_size, _, height, width = pictures.shape
    padded = functional.pad(pictures, (most_px,) * 4, mode="replicate")
    offsets = torch.randint(2 * most_px + 1, (2, batch_size, 1), generator=generator)
    rows = (offsets[0] + torch.arange(height)).to(pictures.device)
    columns = (offsets[1] + torch.arange(width)).to(pictures.device)
    numbers = torch.arange(batch_size, device=pictures.device)
    # [B, H, W, C], since the axis between two sets of indices goes to the end.
    shifted = padded[numbers[:, None, None], :, rows[:, :, None], columns[:, None, :]]
    return shifted.permute(0, 3, 1, 2)


def colour_jitter(pictures: Tensor, most: float, generator: torch.Generator) -> Tensor:
    """Each channel of each picture scaled by up to so much more or less, within 0...1.

    Args:
        pictures: f32[B, C, H, W] in 0...1.
        most: In [0, 1); 0 changes nothing.
        generator: On the CPU; draws the scales.
    """
    if most == 0.0:
        return pictures
    drawn = torch.rand((*pictures.shape[:2], 1, 1), generator=generator)
    scales = (1.0 + most * (2.0 * drawn - 1.0)).to(pictures.device)
    return (pictures * scales).clamp(0.0, 1.0)


def augmented(pictures: Tensor, preset: DiscriminatorPreset, generator: torch.Generator) -> Tensor:
    """Pictures as networks see them in training: turned, shifted, then of other colours.

    Args:
        pictures: f32[B, C, H, W] in 0...1.
        preset: Says by how much.
        generator: On the CPU.
    """
    turned = random_turn(pictures, preset.random_turn_deg, generator)
    shifted = random_shift(turned, preset.random_shift_px, generator)
    return colour_jitter(shifted, preset.colour_jitter, generator)
