"""The tables of a preset: task, algorithm, schedule, optimiser, exploration, initialisation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from broker_config.messages.rules import require
from broker_config.specs import Head
from broker_config.structure import added

TaskOption = bool | int | float | str


@dataclass(frozen=True)
class TaskPreset:
    """The Markov decision process, by the id of its gymnasium environment."""

    environment: str
    """gymnasium id, for example `clothbus/Reaching-v0`."""
    horizon: int
    """T: steps of one episode; its end is a truncation, unless the algorithm says otherwise."""
    observation_shape: tuple[int, int, int]
    n_actions: int
    options: Mapping[str, TaskOption] = field(default_factory=dict)
    """Further keyword arguments of the environment."""

    def __post_init__(self) -> None:
        require(self.horizon >= 1, "task.horizon", "at least 1", self.horizon)


@dataclass(frozen=True)
class AlgorithmPreset:
    """Which value-based update, and its temperatures."""

    method: Literal["dpn", "edpn", "munchausen-dqn", "dqn", "double-dqn", "sqil"]
    """`sqil` (Reddy, Dragan and Levine, 2019) is soft Q-learning that imitates: what was
    demonstrated is rewarded with 1, what the policy itself did with 0, and each minibatch has as
    much of both. It has no use for discriminators, whatever the preset says of them."""
    head: Head
    eta: float
    """Inverse temperature of the smooth policy update (eq. 2.5)."""
    sigma: float
    """Weight of the causal entropy (eq. 4.4); 0 except for EDPN and Munchausen DQN."""
    gamma: float
    """Discount factor of one step, in [0, 1)."""
    ends_at_horizon: bool = added(False)
    """Whether nothing counts after the horizon. Else it only interrupts: the value of an episode's
    last state goes into the teaching signal. That value is never taught where no episode goes on
    from such states, as from folded clothes. Pictures carry no time: where the same ones come early
    and at the horizon, they are taught two values."""

    def __post_init__(self) -> None:
        finite_eta = math.isfinite(self.eta) and self.eta > 0
        require(finite_eta, "algorithm.eta", "a finite positive number", self.eta)
        finite_sigma = math.isfinite(self.sigma) and self.sigma >= 0
        require(finite_sigma, "algorithm.sigma", "a finite number, 0 or more", self.sigma)
        require(0 <= self.gamma < 1, "algorithm.gamma", "a number in [0, 1)", self.gamma)
        if self.method not in ("edpn", "munchausen-dqn"):
            require(self.sigma == 0, "algorithm.sigma", f"0 for {self.method}", self.sigma)
        is_q_head = self.head in ("plain", "dueling-mean")
        is_dpn_head = self.head != "dueling-mean"
        fits = is_q_head if self.is_epsilon_greedy else is_dpn_head
        require(fits, "algorithm.head", f"a head that {self.method} has a meaning for", self.head)

    @property
    def is_epsilon_greedy(self) -> bool:
        """Whether it acts by its preferred action and chance, not by the softmax policy."""
        return self.method not in ("dpn", "edpn", "sqil")

    @property
    def has_soft_value(self) -> bool:
        """Whether V is eq. 2.9, not the largest Q."""
        return self.method not in ("dqn", "double-dqn")

    @property
    def beta(self) -> float:
        """eta / (1 + sigma * eta), eq. 4.8."""
        return self.eta / (1.0 + self.sigma * self.eta)

    @property
    def alpha(self) -> float:
        """1 / (1 + sigma * eta), eq. 4.10; 0 for SQIL, which does not hold on to its policy."""
        return 0.0 if self.method == "sqil" else 1.0 / (1.0 + self.sigma * self.eta)


@dataclass(frozen=True)
class SchedulePreset:
    """How much is collected, and how often the network is updated from it (Algorithm 1)."""

    iterations: int
    """I."""
    episodes_per_iteration: int
    """M."""
    memory_samples: int
    """E: the local memory holds this many of the newest samples."""
    update_every: Literal["episode", "iteration"]
    target_switches: int
    """N: sub-problems of one update, each against a frozen target network."""
    epochs: int
    """U: passes over the memory in each sub-problem."""
    minibatch_size: int
    policy_lag: int = 0
    """Updates by which the acting policy may trail; 0 is the source's strictly sequential order.

    With a lag of d, the ticket that would act on version v acts on exactly version v - d, so that
    1 + d updates' worth of episodes are collected side by side and the result stays repeatable.
    """
    subproblem_loss_threshold: float = 0.0
    """Ends a sub-problem once an epoch's mean loss is below it; 0 switches this off."""

    def __post_init__(self) -> None:
        for name in (
            "iterations",
            "episodes_per_iteration",
            "memory_samples",
            "target_switches",
            "epochs",
            "minibatch_size",
        ):
            require(getattr(self, name) >= 1, f"schedule.{name}", "at least 1", getattr(self, name))
        require(self.policy_lag >= 0, "schedule.policy_lag", "0 or more", self.policy_lag)
        threshold = self.subproblem_loss_threshold
        require(threshold >= 0, "schedule.subproblem_loss_threshold", "0 or more", threshold)

    @property
    def episodes(self) -> int:
        """Episodes of the whole run: I * M."""
        return self.iterations * self.episodes_per_iteration

    def updates_before(self, ticket: int) -> int:
        """Updates that the source's order has made before it collects episode `ticket`."""
        if self.update_every == "episode":
            return ticket
        return ticket // self.episodes_per_iteration

    def policy_version(self, ticket: int) -> int:
        """The policy version on which episode `ticket` acts; version v exists after v updates."""
        return max(0, self.updates_before(ticket) - self.policy_lag)

    def episodes_before(self, version: int) -> int:
        """Episodes that policy `version` has learned from; the inverse of `updates_before`."""
        return version if self.update_every == "episode" else version * self.episodes_per_iteration

    def iteration_versions(self) -> tuple[int, ...]:
        """The untrained policy and the last one of each iteration: these are kept and evaluated."""
        ends = range(0, self.episodes + 1, self.episodes_per_iteration)
        return tuple(self.updates_before(end) for end in ends)

    def updates_after(self, ticket: int) -> bool:
        """Whether the network is updated once episode `ticket` is in the memory."""
        return self.updates_before(ticket + 1) > self.updates_before(ticket)


@dataclass(frozen=True)
class OptimiserPreset:
    """The gradient method and its constants."""

    name: Literal["rmsprop", "adam"]
    learning_rate: float
    epsilon: float
    """Added to the root of the running mean square."""
    smoothing: float = 0.95
    """RMSProp's decay of the running mean square; Adam does not use it."""

    def __post_init__(self) -> None:
        rate = self.learning_rate
        require(math.isfinite(rate) and rate > 0, "optimiser.learning_rate", "positive", rate)
        require(self.epsilon > 0, "optimiser.epsilon", "positive", self.epsilon)
        require(0 <= self.smoothing < 1, "optimiser.smoothing", "in [0, 1)", self.smoothing)


@dataclass(frozen=True)
class ExplorationPreset:
    """DQN's epsilon-greedy schedule; the DPN family samples its softmax policy instead."""

    epsilon_start: float
    epsilon_end: float
    decay_episodes: int
    """Episodes over which epsilon falls linearly."""

    def __post_init__(self) -> None:
        ordered = 0 <= self.epsilon_end <= self.epsilon_start <= 1
        got = (self.epsilon_start, self.epsilon_end)
        require(ordered, "exploration", "0 <= epsilon_end <= epsilon_start <= 1", got)
        require(
            self.decay_episodes >= 1,
            "exploration.decay_episodes",
            "at least 1",
            self.decay_episodes,
        )

    def epsilon(self, ticket: int) -> float:
        """Probability of a random action in episode `ticket`."""
        fraction = min(1.0, ticket / self.decay_episodes)
        return self.epsilon_start + fraction * (self.epsilon_end - self.epsilon_start)


@dataclass(frozen=True)
class AugmentationPreset:
    """How pictures are changed, anew in each epoch, before the network learns from them.

    For tasks whose actions mean the same wherever the picture shows things, as fold lines of a
    garment's outline do within limits: see `actors.cloth.fold_lines.MOST_TURN_DEG`.
    """

    turn_deg: float
    """By up to so much, either way; 0 for not at all."""
    shift_px: int
    """By up to so many, either way; 0 for not at all."""

    def __post_init__(self) -> None:
        turn, shift = self.turn_deg, self.shift_px
        require(0 <= turn <= 180, "augmentation.turn_deg", "0 to 180", turn)
        require(shift >= 0, "augmentation.shift_px", "at least 0", shift)


@dataclass(frozen=True)
class InitialisationPreset:
    """Algorithm 2: the policy is initialised from demonstrations."""

    demonstration_samples: int
    """L: samples loaded into the memory before the first episode."""
    target_switches: int
    """K: target switches of the initial update."""

    def __post_init__(self) -> None:
        samples = self.demonstration_samples
        require(samples >= 1, "initialisation.demonstration_samples", "at least 1", samples)
        require(
            self.target_switches >= 1,
            "initialisation.target_switches",
            "at least 1",
            self.target_switches,
        )
