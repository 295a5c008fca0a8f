"""The table of a preset that says what is imitated, and by which discriminators."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from broker_config.messages.rules import require
from broker_config.structure import added


@dataclass(frozen=True)
class DiscriminatorPreset:
    """How discriminators are trained and their rewards formed; the source gives none of it."""

    learning_rate: float
    """Of Adam."""
    adam_beta1: float
    minibatch_size: int
    """Real states of a minibatch, and as many generated ones."""
    random_shift_px: int
    """Pictures, real and generated alike, are shifted by up to so much; 0 for none."""
    colour_jitter: float
    """Colours are scaled by up to so much more or less; 0 for none."""
    spectral_norm: bool
    """Whether each layer's largest singular value is held at 1."""
    most_accuracy: float
    """An iteration's epochs end once the discriminator is right so often; 1 for never."""
    gradient_penalty: float
    """Weight of the squared gradient by real pictures; 0 for none."""
    target_prior: float
    """Portion of target states among the generated ones, for D_T's non-negative loss of positive
    and unlabelled data; 0 for the loss of eq. 4.13."""
    reward_bound: float
    """A discriminator's reward is at most this."""
    normalise_each: bool
    """Whether each discriminator's rewards are brought to the same spread before they are added."""
    centre_rewards: bool
    """Whether their mean over D_G is subtracted."""
    random_turn_deg: float = added(0.0)
    """Pictures, real and generated alike, are turned by up to so much; 0 for not at all."""

    def __post_init__(self) -> None:
        for name in ("learning_rate", "reward_bound"):
            value = getattr(self, name)
            ok = math.isfinite(value) and value > 0
            require(ok, f"imitation.discriminator.{name}", "a finite positive number", value)
        for name in ("adam_beta1", "colour_jitter", "target_prior"):
            value = getattr(self, name)
            require(0 <= value < 1, f"imitation.discriminator.{name}", "in [0, 1)", value)
        for name, least in (("minibatch_size", 1), ("random_shift_px", 0), ("gradient_penalty", 0)):
            value = getattr(self, name)
            ok = math.isfinite(value) and value >= least
            require(ok, f"imitation.discriminator.{name}", f"at least {least}", value)
        turn = self.random_turn_deg
        require(0 <= turn <= 180, "imitation.discriminator.random_turn_deg", "0 to 180", turn)
        accuracy = self.most_accuracy
        rule = "a portion above 0.5, at most 1"
        require(0.5 < accuracy <= 1, "imitation.discriminator.most_accuracy", rule, accuracy)


@dataclass(frozen=True)
class ImitationPreset:
    """What is imitated; by Algorithm 4 rewards come from discriminators."""

    discriminators: Literal["expert", "target", "both"]
    demonstration_samples: int
    """Samples of D_E."""
    discriminator_epochs: int
    """J."""
    generator_epochs: int
    """K: the schedule's target switches times its epochs. How often the target network is switched
    in them is lost with Algorithm 4's indentation."""
    discriminator: DiscriminatorPreset
    target_reward: float | None = None
    """A demonstrated state is a target where its task reward is at least this; without it the last
    state of each demonstration that succeeded at its end is one."""

    def __post_init__(self) -> None:
        for name in ("demonstration_samples", "discriminator_epochs", "generator_epochs"):
            value = getattr(self, name)
            require(value >= 1, f"imitation.{name}", "at least 1", value)
