"""Gradient steps towards fixed teaching signals, one minibatch after the other."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional

from actors.networks import PreferenceNetwork
from learner.memory import LocalMemory
from learner.steps.optimiser import FusedAdam


def preference_loss(
    network: PreferenceNetwork, observations: Tensor, actions: Tensor, targets: Tensor
) -> Tensor:
    """Mean of (y - P(s, a; theta))**2, f32[].

    Source: eqs. 3.2 and 4.11.

    Args:
        network: Gives P.
        observations: u8[B, H, W, C].
        actions: i64[B].
        targets: The teaching signals y, f32[B].
    """
    chosen = network(observations).gather(1, actions.unsqueeze(1)).squeeze(1)
    return functional.mse_loss(chosen, targets)


class GradientSteps(Protocol):
    """Whatever makes gradient steps on a network from a memory."""

    def run(self, batches: Tensor, targets: Tensor) -> Tensor:
        """Makes one step for each minibatch, in order.

        Args:
            batches: Indices of samples, i64[S, B], on the CPU.
            targets: y of every sample of the memory, f32[n], on the memory's device.

        Returns:
            The loss of each minibatch before its step, f32[S], on the memory's device.
        """


class EagerSteps:
    """Makes the steps one operation at a time."""

    def __init__(
        self, network: PreferenceNetwork, optimiser: FusedAdam, memory: LocalMemory
    ) -> None:
        self._network = network
        self._optimiser = optimiser
        self._memory = memory

    def run(self, batches: Tensor, targets: Tensor) -> Tensor:
        """See `GradientSteps.run`."""
        positions, actions = self._memory.ring_positions, self._memory.samples.actions
        losses = torch.empty(len(batches), device=self._memory.device)
        for step, batch in enumerate(batches):
            observations = self._memory.learned_from[positions[batch]]
            loss = preference_loss(self._network, observations, actions[batch], targets[batch])
            self._optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self._optimiser.step()
            losses[step] = loss.detach()
        return losses
