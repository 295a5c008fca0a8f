"""What a network says of every sample of a memory: values, and what it is to be taught next."""

from __future__ import annotations

import math
from typing import NamedTuple

from torch import Tensor

from broker_config.preset import AlgorithmPreset
from learner.memory import Samples
from learner.teaching_signal import (
    MUNCHAUSEN_BOUND,
    bellman_target,
    double_q_value,
    dpn_teaching_signal,
    entropy,
    epsilon_greedy_entropy,
    epsilon_greedy_value,
    soft_value,
)


class Assessment(NamedTuple):
    """What the network says of every sample of the memory."""

    preferences: Tensor
    """P of every picture of the memory, f32[F, A]."""
    teaching_signals: Tensor
    """y with this network as the target network, f32[n]."""
    values: Tensor
    """V(s), f32[n]."""
    bellman_targets: Tensor
    """r + gamma * V(s'), f32[n]."""
    mean_entropy: Tensor
    """f32[]."""


def assess(
    algorithm: AlgorithmPreset, samples: Samples, preferences: Tensor, epsilon: float
) -> Assessment:
    """Values and teaching signals, with the network that gave the preferences as target network.

    Args:
        algorithm: Whose teaching signal.
        samples: Of the memory.
        preferences: P of every picture of the memory, f32[F, A]: each is s of one sample and s' of
            another.
        epsilon: Probability of a random action, for methods whose value depends on it.
    """
    here, after = samples.positions, samples.positions + 1
    if not algorithm.has_soft_value:
        values = epsilon_greedy_value(preferences, epsilon)
        best = preferences.amax(1)[after]
        signals = bellman_target(samples.rewards, best, samples.terminated, algorithm.gamma)
        mean_entropy = epsilon_greedy_entropy(epsilon, preferences.shape[1])
    else:
        values = soft_value(preferences, algorithm.beta)
        is_munchausen = algorithm.method == "munchausen-dqn"
        signals = dpn_teaching_signal(
            preferences[here, samples.actions],
            values[here],
            samples.rewards,
            values[after],
            samples.terminated,
            alpha=algorithm.alpha,
            gamma=algorithm.gamma,
            least_log_policy=MUNCHAUSEN_BOUND if is_munchausen else -math.inf,
        )
        mean_entropy = entropy(preferences[here], algorithm.beta).mean()
    targets = bellman_target(samples.rewards, values[after], samples.terminated, algorithm.gamma)
    return Assessment(preferences, signals, values[here], targets, mean_entropy)


def double_q_signals(
    algorithm: AlgorithmPreset, samples: Samples, frozen: Tensor, choosing: Tensor
) -> Tensor:
    """Teaching signals of double DQN, f32[n].

    Args:
        algorithm: Gives gamma.
        samples: Of the memory.
        frozen: Q of every picture under the target network, f32[F, A].
        choosing: The same under the network that is trained.
    """
    after = samples.positions + 1
    values = double_q_value(frozen[after], choosing[after])
    return bellman_target(samples.rewards, values, samples.terminated, algorithm.gamma)
