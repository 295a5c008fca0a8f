"""The ways in which an actor may choose: each has `act`, as `rollout` asks for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from actors.rollout import ActingPolicy, Observation
from broker_config.preset import AlgorithmPreset

if TYPE_CHECKING:
    from actors.policy import Policy  # brings torch, which scripts and chance do without


@dataclass(frozen=True)
class Sampled:
    """Draws from the softmax policy (eq. 2.10): how the DPN family collects."""

    policy: Policy

    def act(self, observation: Observation, generator: np.random.Generator, epsilon: float) -> int:
        """A draw; epsilon has no meaning here."""
        del epsilon
        return self.policy.sample(observation, generator)


@dataclass(frozen=True)
class EpsilonGreedy:
    """The preferred action, or with probability epsilon any: how the DQN family collects."""

    policy: Policy

    def act(self, observation: Observation, generator: np.random.Generator, epsilon: float) -> int:
        """The preferred action or a random one."""
        return self.policy.epsilon_greedy(observation, epsilon, generator)


@dataclass(frozen=True)
class Greedy:
    """The preferred action, always: for evaluation."""

    policy: Policy

    def act(self, observation: Observation, generator: np.random.Generator, epsilon: float) -> int:
        """The preferred action; nothing is random."""
        del generator, epsilon
        return self.policy.greedy(observation)


@dataclass(frozen=True)
class UniformlyRandom:
    """Any action: the baseline below which nobody should be."""

    n_actions: int

    def act(self, observation: Observation, generator: np.random.Generator, epsilon: float) -> int:
        """Any action, whatever the picture."""
        del observation, epsilon
        return int(generator.integers(self.n_actions))


def collecting_policy(algorithm: AlgorithmPreset, policy: Policy) -> ActingPolicy:
    """How an algorithm's actors collect: DQN epsilon-greedily, the DPN family by its softmax."""
    return EpsilonGreedy(policy) if algorithm.is_epsilon_greedy else Sampled(policy)
