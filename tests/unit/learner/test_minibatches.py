"""Which samples make up each minibatch."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from learner.minibatches import balanced, shuffled


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(1)


@given(st.integers(1, 60), st.integers(1, 20))
def test_an_epoch_visits_no_sample_twice(n_samples: int, batch_size: int) -> None:
    batches = shuffled(n_samples, batch_size, generator())
    assert batches.shape[1] == min(batch_size, n_samples)
    visited = batches.flatten().tolist()
    assert len(set(visited)) == len(visited) == n_samples - n_samples % batches.shape[1]
    assert set(visited) <= set(range(n_samples))


@given(st.integers(1, 30), st.integers(1, 60), st.integers(1, 10))
def test_half_of_a_balanced_minibatch_is_held(n_held: int, n_others: int, half: int) -> None:
    batches = balanced(n_held, n_held + n_others, 2 * half, generator())
    assert len(batches) == max(1, len(shuffled(n_others, 2 * half, generator())))
    held, others = batches.chunk(2, 1)
    assert held.shape == others.shape
    assert held.shape[1] == min(half, n_others)
    assert bool(((held >= 0) & (held < n_held)).all())
    assert bool(((others >= n_held) & (others < n_held + n_others)).all())
    assert others.unique().numel() == others.numel()


def test_every_sample_has_its_turn() -> None:
    drawing = generator()
    drawn = torch.cat([balanced(6, 26, 10, drawing).flatten() for _ in range(40)])
    assert drawn.unique().tolist() == list(range(26))
