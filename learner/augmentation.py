"""Pictures as a network learns from them, where nothing is to be told from how they lie.

Source: Kostrikov, Yarats and Fergus, Image Augmentation Is All You Need: Regularizing Deep
Reinforcement Learning from Pixels, 2020. Differs: what is taught is computed on the pictures as
they are, once for a sub-problem, and pictures are turned, too.
"""

from __future__ import annotations

import torch
from torch import Tensor

from broker_config.preset import AugmentationPreset
from discriminator.augmentation import random_shift, random_turn


def augmented(pictures: Tensor, preset: AugmentationPreset, generator: torch.Generator) -> Tensor:
    """Each picture turned about its centre, then shifted, its border repeated.

    Args:
        pictures: u8[B, H, W, C].
        preset: Says by how much at most.
        generator: On the CPU; draws by how much.

    Returns:
        Of the same shape and dtype.
    """
    maps = pictures.permute(0, 3, 1, 2).to(torch.float32)
    turned = random_turn(maps, preset.turn_deg, generator)
    shifted = random_shift(turned, preset.shift_px, generator)
    return shifted.round().to(torch.uint8).permute(0, 2, 3, 1)
