"""Losses of the discriminators, as functions of logits: D = sigmoid(logit).

-log D is softplus(-logit) and -log(1 - D) is softplus(logit), which no logit overflows.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import softplus

from discriminator.networks import DiscriminatorNetwork


def discriminator_loss(generated: Tensor, real: Tensor) -> Tensor:
    """E_pi[-log(1 - D)] + E_real[-log D], f32[].

    Source: eqs. 4.12 and 4.13.

    Args:
        generated: Logits of states that the policy has reached, f32[B].
        real: Logits of demonstrated states, or of target states, f32[B].
    """
    return softplus(generated).mean() + softplus(-real).mean()


def non_negative_loss(generated: Tensor, real: Tensor, prior: float) -> Tensor:
    """The loss where some generated states are real ones, f32[].

    A policy that has learned reaches targets, too: generated states are unlabelled, not false. With
    prior pi: pi * E_real[-log D] + max(0, E_pi[-log(1 - D)] - pi * E_real[-log(1 - D)]).

    Source: Kiryo et al., Positive-Unlabeled Learning with Non-Negative Risk Estimator, 2017.

    Args:
        generated: Logits of states that the policy has reached, f32[B].
        real: Logits of target states, f32[B].
        prior: Portion of real states among the generated ones, in (0, 1).
    """
    false = softplus(generated).mean() - prior * softplus(real).mean()
    return prior * softplus(-real).mean() + false.clamp_min(0.0)


def gradient_penalty(network: DiscriminatorNetwork, real: Tensor) -> Tensor:
    """Mean squared norm of the logit's gradient by real pictures, f32[].

    Source: Mescheder, Geiger and Nowozin, Which Training Methods for GANs do actually Converge?,
    2018 (R1).

    Args:
        network: Gives the logits.
        real: f32[B, C, H, W].
    """
    pictures = real.detach().requires_grad_()
    (gradients,) = torch.autograd.grad(network(pictures).sum(), pictures, create_graph=True)
    return gradients.square().sum((1, 2, 3)).mean()


def accuracy(generated: Tensor, real: Tensor) -> float:
    """Portion of logits on the right side of 0, generated and real counted alike."""
    right = (generated < 0).float().mean() + (real > 0).float().mean()
    return float(right) / 2
