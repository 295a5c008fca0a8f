"""Pictures as a network learns from them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from broker_config.errors import MessageError
from broker_config.preset import AugmentationPreset
from learner.augmentation import augmented


def generator_of(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def pictures() -> Tensor:
    return torch.randint(256, (20, 36, 36, 3), generator=generator_of(0), dtype=torch.uint8)


def test_nothing_changes_where_nothing_is_asked_for() -> None:
    assert torch.equal(
        augmented(pictures(), AugmentationPreset(0.0, 0), generator_of(1)), pictures()
    )


def test_a_shifted_picture_is_the_same_but_for_its_border() -> None:
    moved = augmented(pictures(), AugmentationPreset(0.0, 2), generator_of(1))
    shifts = set()
    for before, after in zip(pictures(), moved, strict=True):
        found = [
            (down, right)
            for down in range(-2, 3)
            for right in range(-2, 3)
            if torch.equal(after[2:-2, 2:-2], before[2 - down : 34 - down, 2 - right : 34 - right])
        ]
        assert len(found) == 1
        shifts.update(found)
    assert len(shifts) > 8


def test_what_is_drawn_follows_from_the_generator() -> None:
    preset = AugmentationPreset(30.0, 4)
    first, again, other = (augmented(pictures(), preset, generator_of(s)) for s in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert (first.shape, first.dtype) == (pictures().shape, torch.uint8)


@pytest.mark.parametrize(
    ("turn_deg", "shift_px", "said"),
    [(181.0, 0, "augmentation.turn_deg: expected 0 to 180"), (0.0, -1, "shift_px: expected at")],
)
def test_what_makes_no_sense_is_refused(turn_deg: float, shift_px: int, said: str) -> None:
    with pytest.raises(MessageError, match=said):
        AugmentationPreset(turn_deg, shift_px)
