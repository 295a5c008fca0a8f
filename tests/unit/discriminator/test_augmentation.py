"""Shifts and colours: what changes, and what must not."""

from __future__ import annotations

import torch

from discriminator.augmentation import colour_jitter, random_shift


def generator_of(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_a_picture_is_shifted_as_a_whole_and_its_border_repeated() -> None:
    pictures = torch.rand((40, 3, 12, 10), generator=generator_of(0))
    shifted = random_shift(pictures, 3, generator_of(1))
    seen = set()
    for picture, moved in zip(pictures, shifted, strict=True):
        found = [
            (down, right)
            for down in range(-3, 4)
            for right in range(-3, 4)
            if torch.equal(moved, shifted_by_hand(picture, down, right))
        ]
        assert len(found) == 1
        seen.update(found)
    assert len(seen) > 20  # of 49


def shifted_by_hand(picture: torch.Tensor, down: int, right: int) -> torch.Tensor:
    _, height, width = picture.shape
    rows = (torch.arange(height) - down).clamp(0, height - 1)
    columns = (torch.arange(width) - right).clamp(0, width - 1)
    return picture[:, rows][:, :, columns]


def test_colours_are_scaled_channel_by_channel() -> None:
    pictures = torch.full((50, 3, 4, 4), 0.5)
    changed = colour_jitter(pictures, 0.2, generator_of(0))
    scales = changed / 0.5
    assert (scales == scales[..., :1, :1]).all()
    assert 0.8 <= scales.min() < 0.85
    assert 1.15 < scales.max() <= 1.2
    bright = colour_jitter(torch.ones((50, 3, 4, 4)), 0.2, generator_of(0))
    assert bright.max() == 1.0


def test_none_asked_for_is_none_made() -> None:
    pictures = torch.rand((2, 3, 8, 8), generator=generator_of(0))
    assert random_shift(pictures, 0, generator_of(1)) is pictures
    assert colour_jitter(pictures, 0.0, generator_of(1)) is pictures
