"""Soft values, policies and teaching signals, as pure functions of tensors.

Notation of the source: P action preferences, eta inverse temperature, sigma causal-entropy weight,
beta = eta / (1 + sigma * eta), alpha = 1 / (1 + sigma * eta), gamma discount. All are float32, and
gradients flow through every function.

An episode that runs into its horizon is truncated, not terminated: the value of its last state goes
into the teaching signal. Only `terminated` cuts it off, which a preset may let the horizon do.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import torch
from torch import Tensor

MUNCHAUSEN_BOUND: Final = -1.0
"""l0, as published."""


def soft_value(preferences: Tensor, beta: float) -> Tensor:
    """V(s) = log(sum over a of exp(beta * P(s, a))) / beta.

    Source: eqs. 2.9 and 4.9.

    Args:
        preferences: f32[B, A].
        beta: Greater than 0; towards infinity the result becomes the maximum.

    Returns:
        f32[B].
    """
    # torch subtracts the maximum first: nothing overflows, however large beta * P is.
    return torch.logsumexp(beta * preferences, 1) / beta


def softmax_policy(preferences: Tensor, beta: float) -> Tensor:
    """pi(a given s) = softmax over a of beta * P(s, a), f32[B, A].

    Source: eqs. 2.10 and 4.8.
    """
    return torch.softmax(beta * preferences, 1)


def entropy(preferences: Tensor, beta: float) -> Tensor:
    """Entropy of the softmax policy in nats, f32[B].

    Source: eq. 4.6.
    """
    log_policy = torch.log_softmax(beta * preferences, 1)
    return -(log_policy.exp() * log_policy).sum(1)


def epsilon_greedy_value(preferences: Tensor, epsilon: float) -> Tensor:
    """E over the epsilon-greedy policy of Q(s, a), f32[B]: DQN's value in eq. 3.6."""
    return (1.0 - epsilon) * preferences.amax(1) + epsilon * preferences.mean(1)


def epsilon_greedy_entropy(epsilon: float, n_actions: int) -> Tensor:
    """Entropy of the epsilon-greedy policy in nats, the same in every state, f32[]."""
    others = torch.full((n_actions,), epsilon / n_actions)
    others[0] += 1.0 - epsilon
    return -torch.xlogy(others, others).sum()


def dpn_teaching_signal(
    chosen: Tensor,
    values: Tensor,
    rewards: Tensor,
    next_values: Tensor,
    terminated: Tensor,
    *,
    alpha: float,
    gamma: float,
    least_log_policy: float = -math.inf,
) -> Tensor:
    """y = alpha * (P(s, a) - V(s)) + r + gamma * V(s'), of EDPN and of DPN.

    Source: eqs. 4.7 and 4.10; with alpha = 1 (sigma = 0) eqs. 2.11 and 3.1, bit for bit, since a
    product with 1.0 is exact. P(s, a) - V(s) is log pi(a given s) / beta: with a bound below it the
    signal is Munchausen DQN's (Vieillard, Pietquin and Geist, 2020: tau is 1 / beta, l0 the bound).

    Args:
        chosen: P(s, a) of the taken actions under the target network, f32[B].
        values: V(s) under the target network, f32[B].
        rewards: f32[B].
        next_values: V(s') under the target network, f32[B].
        terminated: bool[B]; where True, there is no value after the transition.
        alpha: 1 / (1 + sigma * eta).
        gamma: Discount factor.
        least_log_policy: Below it log pi / beta is not followed.

    Returns:
        f32[B].
    """
    log_policy = (chosen - values).clamp_min(least_log_policy)
    return alpha * log_policy + bellman_target(rewards, next_values, terminated, gamma)


def double_q_value(preferences: Tensor, choosing: Tensor) -> Tensor:
    """Q(s, a) under the target network of the action that the network itself prefers, f32[B].

    Source: van Hasselt, Guez and Silver, Deep Reinforcement Learning with Double Q-learning, 2016.

    Args:
        preferences: Q under the target network, f32[B, A].
        choosing: Q under the network, f32[B, A].
    """
    return preferences.gather(1, choosing.argmax(1, keepdim=True)).squeeze(1)


def bellman_target(
    rewards: Tensor, next_values: Tensor, terminated: Tensor, gamma: float
) -> Tensor:
    """r + gamma * V(s'), without the second term after a termination, f32[B].

    With max over a' of Q(s', a') as V(s') it is DQN's teaching signal.

    Source: eqs. 2.12 and 3.6.
    """
    return rewards + gamma * torch.where(terminated, 0.0, next_values)


class BellmanError(NamedTuple):
    """How far one sub-problem's values are from those that they were to become."""

    absolute: Tensor
    """Mean of abs(V_{t+1}(s) - (r + gamma * V_t(s'))), f32[]."""
    relative: Tensor
    """The same in standard deviations of V_{t+1}, f32[].

    A soft value carries log(n_actions) / beta, and preferences drift; the ratio compares methods.
    """


def bellman_error(updated_values: Tensor, targets: Tensor) -> BellmanError:
    """The Bellman error of figure 3.7.

    Source: eq. 3.6.

    Args:
        updated_values: V_{t+1}(s), f32[B].
        targets: r + gamma * V_t(s'), f32[B], from `bellman_target`.
    """
    absolute = (updated_values - targets).abs().mean()
    spread = updated_values.std(correction=0)
    return BellmanError(absolute, absolute / spread.clamp_min(torch.finfo(spread.dtype).tiny))
