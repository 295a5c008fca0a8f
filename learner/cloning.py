"""Behaviour cloning: supervised learning of demonstrated actions, the source's "Supervised"."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from actors.networks import PreferenceNetwork, build_network
from broker_config.errors import MessageError
from broker_config.messages import Trajectory
from broker_config.preset import DiscriminatorPreset, Preset
from broker_config.seeds import SHUFFLING_STREAM, WEIGHTS_STREAM, stream_seed
from discriminator.augmentation import augmented
from discriminator.networks import as_input
from learner.memory import LocalMemory
from learner.minibatches import shuffled
from learner.steps.optimiser import build_optimiser


@dataclass(frozen=True)
class Cloned:
    """A policy that imitates."""

    weights: dict[str, Tensor]
    """Of a network of `cloning_preset(preset).network`."""
    gradient_steps: int
    loss: float
    """Mean over the last epoch."""


def cloning_preset(preset: Preset) -> Preset:
    """The preset with the plain network of a softmax policy, which is what is cloned."""
    return replace(
        preset, algorithm=replace(preset.algorithm, method="dpn", head="plain", sigma=0.0)
    )


def cloning_loss(
    network: PreferenceNetwork, observations: Tensor, actions: Tensor, beta: float
) -> Tensor:
    """Mean of -log pi(a given s) with pi = softmax of beta * P, f32[].

    Args:
        network: Gives P.
        observations: u8[B, H, W, C], or the same already as f32 in 0...255.
        actions: i64[B].
        beta: Inverse temperature.
    """
    return functional.cross_entropy(beta * network(observations), actions)


def clone(
    preset: Preset,
    demonstrations: Iterable[Trajectory],
    epochs: int,
    augmentation: DiscriminatorPreset | None = None,
) -> Cloned:
    """Trains a policy to choose what the demonstrations chose.

    Minibatches, optimiser and initial weights are those of the preset's learner.

    Args:
        preset: Gives network, optimiser, minibatch size and seed.
        demonstrations: At least one.
        epochs: How often each sample is learned from.
        augmentation: Pictures are shifted, turned and of other colours as these discriminators
            see them; with None they are learned from as they are.

    Raises:
        MessageError: There are no demonstrations.
    """
    preset, given = cloning_preset(preset), list(demonstrations)
    if not given:
        raise MessageError("cloning: expected demonstrations; got none; record some")
    memory = LocalMemory(sum(each.steps for each in given), preset.task.observation_shape)
    for each in given:
        memory.add(each.observations, each.actions, each.rewards, each.terminated)
    network = build_network(
        preset.network, stream_seed(preset.seed, WEIGHTS_STREAM), starts_at_zero_value=False
    )
    optimiser = build_optimiser(preset.optimiser, network)
    shuffling = torch.Generator().manual_seed(stream_seed(preset.seed, SHUFFLING_STREAM))
    losses: list[float] = []
    for _ in range(epochs):
        batches = shuffled(len(memory), preset.schedule.minibatch_size, shuffling)
        for batch in batches:
            picked = memory.minibatch(batch)
            seen = picked.observations
            if augmentation is not None:
                seen = _augmented(seen, augmentation, shuffling)
            loss = cloning_loss(network, seen, picked.actions, preset.algorithm.beta)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            losses.append(loss.item())
    weights = {name: part.detach().clone() for name, part in network.state_dict().items()}
    return Cloned(weights, len(losses), float(np.mean(losses[-len(batches) :])))


def _augmented(
    observations: Tensor, preset: DiscriminatorPreset, generator: torch.Generator
) -> Tensor:
    """Pictures f32[B, H, W, C] in 0...255, as the network takes them, of u8[B, H, W, C]."""
    return 255.0 * augmented(as_input(observations), preset, generator).permute(0, 2, 3, 1)
