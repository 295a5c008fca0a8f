"""Shifts and colours: what changes, and what must not."""

from __future__ import annotations

import math

import pytest
import torch

from discriminator.augmentation import colour_jitter, random_shift, random_turn


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


def test_pictures_are_turned_about_their_centre_and_keep_their_shape() -> None:
    height, width = 40, 60
    down, right = torch.meshgrid(
        torch.arange(height) - 19.5, torch.arange(width) - 29.5, indexing="ij"
    )
    bar = ((down.abs() <= 3) & (right.abs() <= 14)).float()
    turned = random_turn(bar.expand(60, 1, height, width), 30.0, generator_of(0))[:, 0]
    length = ((bar * right**2).sum() / bar.sum()).sqrt().item()
    angles_deg = []
    for picture in turned:
        mass = picture.sum().item()
        assert mass == pytest.approx(bar.sum().item(), rel=0.03)
        assert abs((picture * down).sum().item() / mass) < 0.1
        across, along, athwart = (
            (picture * a * b).sum().item() for a, b in ((down, right), (right, right), (down, down))
        )
        angle_rad = 0.5 * math.atan2(2 * across, along - athwart)
        place = right * math.cos(angle_rad) + down * math.sin(angle_rad)
        spread = (picture * place**2).sum().item() / mass
        assert math.sqrt(spread) == pytest.approx(length, rel=0.03)
        angles_deg.append(math.degrees(angle_rad))
    assert 25 < max(angles_deg) <= 31
    assert -31 <= min(angles_deg) < -25


def test_a_turned_picture_repeats_its_border() -> None:
    pictures = torch.full((3, 1, 10, 14), 0.25)
    assert torch.allclose(random_turn(pictures, 180.0, generator_of(0)), pictures)


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
    assert random_turn(pictures, 0.0, generator_of(1)) is pictures
    assert random_shift(pictures, 0, generator_of(1)) is pictures
    assert colour_jitter(pictures, 0.0, generator_of(1)) is pictures
