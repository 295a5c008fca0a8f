"""Which samples of a memory make up each minibatch."""

from __future__ import annotations

import torch
from torch import Tensor


def shuffled(n_samples: int, batch_size: int, generator: torch.Generator) -> Tensor:
    """An epoch over all samples, without those left over: others in each epoch.

    Args:
        n_samples: Of the memory; where they are fewer than a minibatch, they are a smaller one.
        batch_size: Of a minibatch.
        generator: On the CPU.

    Returns:
        Indices i64[S, B].
    """
    batch_size = min(batch_size, n_samples)
    n_batches = n_samples // batch_size
    order = torch.randperm(n_samples, generator=generator)[: n_batches * batch_size]
    return order.view(-1, batch_size)


def balanced(n_held: int, n_samples: int, batch_size: int, generator: torch.Generator) -> Tensor:
    """An epoch of minibatches that are one half samples that are held, one half others.

    It has as many minibatches as the others alone would make: a method that holds some makes no
    more gradient steps than one that does not. No sample of the others comes twice; those that are
    held are drawn with replacement.

    Args:
        n_held: Samples that are held: the first ones.
        n_samples: Of the memory, more than are held.
        batch_size: Of a minibatch, even.
        generator: On the CPU.

    Returns:
        Indices i64[S, B], those that are held in the first half of each minibatch.
    """
    n_others = n_samples - n_held
    half = min(batch_size // 2, n_others)
    n_batches = max(1, n_others // batch_size)
    held = torch.randint(n_held, (n_batches, half), generator=generator)
    others = torch.randperm(n_others, generator=generator)[: n_batches * half]
    return torch.cat((held, n_held + others.view(-1, half)), 1)
