"""A preset as a whole: its tables, which must fit each other, and its digest."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass

from broker_config.messages.rules import require
from broker_config.preset.imitation import ImitationPreset
from broker_config.preset.tables import (
    AlgorithmPreset,
    AugmentationPreset,
    ExplorationPreset,
    InitialisationPreset,
    OptimiserPreset,
    SchedulePreset,
    TaskPreset,
)
from broker_config.specs import NetworkSpec
from broker_config.structure import added, to_plain


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
    augmentation: AugmentationPreset | None = added(None)

    def __post_init__(self) -> None:
        require(0 <= self.seed < 2**32, "seed", "a number in [0, 2**32)", self.seed)
        if self.algorithm.is_epsilon_greedy:
            rule = f"a table for {self.algorithm.method}"
            require(self.exploration is not None, "exploration", rule, None)
        if self.algorithm.method == "sqil":
            has_table, rule = self.imitation is not None, "a table that says what sqil imitates"
            require(has_table, "imitation", rule, None)
            size = self.schedule.minibatch_size
            rule = "an even number for sqil: half are demonstrated"
            require(size % 2 == 0, "schedule.minibatch_size", rule, size)
        if self.imitation is not None:
            made = self.schedule.target_switches * self.schedule.epochs
            rule = f"schedule.target_switches * schedule.epochs, {made}"
            epochs = self.imitation.generator_epochs
            require(epochs == made, "imitation.generator_epochs", rule, epochs)
            when = self.schedule.update_every
            require(when == "iteration", "schedule.update_every", "iteration, to imitate", when)
            rule = "none beside [imitation], whose memory is all of the policy's own"
            require(self.initialisation is None, "initialisation", rule, self.initialisation)
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
