"""Independent random numbers of one preset's seed."""

from __future__ import annotations

from typing import Final

import numpy as np

WEIGHTS_STREAM: Final = 0
SHUFFLING_STREAM: Final = 1
EXPERT_DISCRIMINATOR_STREAM: Final = 2
TARGET_DISCRIMINATOR_STREAM: Final = 3
AUGMENTATION_STREAM: Final = 4


def stream_seed(seed: int, stream: int) -> int:
    """The seed of one use; streams are independent of each other, and of every ticket."""
    sequence = np.random.SeedSequence(seed, spawn_key=(stream,))
    return int(sequence.generate_state(1, np.uint64)[0])
