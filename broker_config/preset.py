"""The preset: every choice of an experiment, as one frozen value with a digest.

A preset is written as TOML; `deploy/presets` holds one for each table of the source. Both ends of
the bus compare its digest before they work together.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from broker_config.errors import MessageError, PresetError
from broker_config.specs import Head, NetworkSpec
from broker_config.structure import added, from_plain, to_plain

TaskOption = bool | int | float | str


def _require(condition: bool, subject: str, rule: str, got: object) -> None:
    if not condition:
        raise MessageError(f"{subject}: expected {rule}; got {got!r}")


@dataclass(frozen=True)
class TaskPreset:
    """The Markov decision process, by the id of its gymnasium environment."""

    environment: str
    """gymnasium id, for example `clothbus/Reaching-v0`."""
    horizon: int
    """T: steps of one episode; its end is a truncation, never a termination."""
    observation_shape: tuple[int, int, int]
    n_actions: int
    options: Mapping[str, TaskOption] = field(default_factory=dict)
    """Further keyword arguments of the environment."""

    def __post_init__(self) -> None:
        _require(self.horizon >= 1, "task.horizon", "at least 1", self.horizon)


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

    def __post_init__(self) -> None:
        finite_eta = math.isfinite(self.eta) and self.eta > 0
        _require(finite_eta, "algorithm.eta", "a finite positive number", self.eta)
        finite_sigma = math.isfinite(self.sigma) and self.sigma >= 0
        _require(finite_sigma, "algorithm.sigma", "a finite number, 0 or more", self.sigma)
        _require(0 <= self.gamma < 1, "algorithm.gamma", "a number in [0, 1)", self.gamma)
        if self.method not in ("edpn", "munchausen-dqn"):
            _require(self.sigma == 0, "algorithm.sigma", f"0 for {self.method}", self.sigma)
        is_q_head = self.head in ("plain", "dueling-mean")
        is_dpn_head = self.head != "dueling-mean"
        fits = is_q_head if self.is_epsilon_greedy else is_dpn_head
        _require(fits, "algorithm.head", f"a head that {self.method} has a meaning for", self.head)

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
            _require(
                getattr(self, name) >= 1, f"schedule.{name}", "at least 1", getattr(self, name)
            )
        _require(self.policy_lag >= 0, "schedule.policy_lag", "0 or more", self.policy_lag)
        threshold = self.subproblem_loss_threshold
        _require(threshold >= 0, "schedule.subproblem_loss_threshold", "0 or more", threshold)

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
        _require(math.isfinite(rate) and rate > 0, "optimiser.learning_rate", "positive", rate)
        _require(self.epsilon > 0, "optimiser.epsilon", "positive", self.epsilon)
        _require(0 <= self.smoothing < 1, "optimiser.smoothing", "in [0, 1)", self.smoothing)


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
        _require(ordered, "exploration", "0 <= epsilon_end <= epsilon_start <= 1", got)
        _require(
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
class InitialisationPreset:
    """Algorithm 2: the policy is initialised from demonstrations."""

    demonstration_samples: int
    """L: samples loaded into the memory before the first episode."""
    target_switches: int
    """K: target switches of the initial update."""

    def __post_init__(self) -> None:
        samples = self.demonstration_samples
        _require(samples >= 1, "initialisation.demonstration_samples", "at least 1", samples)
        _require(
            self.target_switches >= 1,
            "initialisation.target_switches",
            "at least 1",
            self.target_switches,
        )


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
            _require(ok, f"imitation.discriminator.{name}", "a finite positive number", value)
        for name in ("adam_beta1", "colour_jitter", "target_prior"):
            value = getattr(self, name)
            _require(0 <= value < 1, f"imitation.discriminator.{name}", "in [0, 1)", value)
        for name, least in (("minibatch_size", 1), ("random_shift_px", 0), ("gradient_penalty", 0)):
            value = getattr(self, name)
            ok = math.isfinite(value) and value >= least
            _require(ok, f"imitation.discriminator.{name}", f"at least {least}", value)
        turn = self.random_turn_deg
        _require(0 <= turn <= 180, "imitation.discriminator.random_turn_deg", "0 to 180", turn)
        accuracy = self.most_accuracy
        rule = "a portion above 0.5, at most 1"
        _require(0.5 < accuracy <= 1, "imitation.discriminator.most_accuracy", rule, accuracy)


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
            _require(value >= 1, f"imitation.{name}", "at least 1", value)


@dataclass(frozen=True)
class Preset:
    """Every choice of one experiment."""

    name: str
    source: str
    """The table of the source that it states, or what it was derived from."""
    seed: int
    task: TaskPreset
    algorithm: AlgorithmPreset
    schedule: SchedulePreset
    optimiser: OptimiserPreset
    exploration: ExplorationPreset | None = None
    initialisation: InitialisationPreset | None = None
    imitation: ImitationPreset | None = None

    def __post_init__(self) -> None:
        _require(0 <= self.seed < 2**32, "seed", "a number in [0, 2**32)", self.seed)
        if self.algorithm.is_epsilon_greedy:
            rule = f"a table for {self.algorithm.method}"
            _require(self.exploration is not None, "exploration", rule, None)
        if self.algorithm.method == "sqil":
            has_table, rule = self.imitation is not None, "a table that says what sqil imitates"
            _require(has_table, "imitation", rule, None)
            size = self.schedule.minibatch_size
            rule = "an even number for sqil: half are demonstrated"
            _require(size % 2 == 0, "schedule.minibatch_size", rule, size)
        if self.imitation is not None:
            made = self.schedule.target_switches * self.schedule.epochs
            rule = f"schedule.target_switches * schedule.epochs, {made}"
            epochs = self.imitation.generator_epochs
            _require(epochs == made, "imitation.generator_epochs", rule, epochs)
            when = self.schedule.update_every
            _require(when == "iteration", "schedule.update_every", "iteration, to imitate", when)
            rule = "none beside [imitation], whose memory is all of the policy's own"
            _require(self.initialisation is None, "initialisation", rule, self.initialisation)
        _ = self.network  # refuses shapes and sizes that no network can have

    @property
    def has_discriminators(self) -> bool:
        """Whether rewards come from discriminators."""
        return self.imitation is not None and self.algorithm.method != "sqil"

    @property
    def network(self) -> NetworkSpec:
        """The network that actor and learner both build."""
        return NetworkSpec(
            self.task.observation_shape,
            self.task.n_actions,
            self.algorithm.head,
            self.algorithm.beta,
        )

    @property
    def digest(self) -> str:
        """SHA-256 of the canonical form: equal exactly when every value is equal."""
        canonical = json.dumps(to_plain(self), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()

    def to_json(self) -> str:
        """The preset as it travels in messages and is kept in run folders."""
        return json.dumps(to_plain(self), indent=2)


def preset_from_json(text: str) -> Preset:
    """Reads what `Preset.to_json` wrote.

    Raises:
        PresetError: The text is not a preset of this version.
    """
    try:
        return from_plain(json.loads(text), Preset, "preset")
    except ValueError as error:
        raise PresetError(f"preset: {error}") from error


def with_settings(preset: Preset, overrides: Iterable[str]) -> Preset:
    """The preset with other settings.

    Args:
        preset: Whose others stay.
        overrides: As for `preset_from_toml`.

    Raises:
        PresetError: A setting is unknown, or a value out of range.
    """
    table = json.loads(preset.to_json())
    try:
        for override in overrides:
            _apply(table, override)
        return from_plain(table, Preset, "preset")
    except MessageError as error:
        raise PresetError(str(error)) from error


def preset_from_toml(text: str, overrides: Iterable[str] = ()) -> Preset:
    """Reads a preset file.

    Args:
        text: The TOML text.
        overrides: Settings that replace the file's, each as `schedule.iterations=3` with a TOML
            value on the right.

    Raises:
        PresetError: The text is no TOML, or a value is missing, unknown or out of range.
    """
    try:
        table = tomllib.loads(text)
        for override in overrides:
            _apply(table, override)
        return from_plain(table, Preset, "preset")
    except (tomllib.TOMLDecodeError, MessageError) as error:
        raise PresetError(str(error)) from error


def _apply(table: dict[str, object], override: str) -> None:
    path, separator, literal = override.partition("=")
    if not separator:
        raise PresetError(
            f"override {override!r}: expected KEY=VALUE; write for example schedule.iterations=3"
        )
    *parents, name = path.strip().split(".")
    for parent in parents:
        child = table.setdefault(parent, {})
        if not isinstance(child, dict):
            raise PresetError(f"override {override!r}: {parent} is a value, not a table")
        table = child
    table[name] = toml_value(literal.strip())


def toml_value(literal: str) -> object:
    """What is written after `key=` on a command line: a TOML value, or else plain text."""
    try:
        return tomllib.loads(f"value = {literal}")["value"]
    except tomllib.TOMLDecodeError:
        return literal


def with_seed(preset: Preset, seed: int) -> Preset:
    """The same experiment on another seed."""
    return dataclasses.replace(preset, seed=seed)
