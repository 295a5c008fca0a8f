"""Demonstrations: who made them, and which of their states a person marked as targets."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

from broker_config.messages.rules import require, require_count, require_digest, require_id
from broker_config.messages.trajectories import TrajectoryId


@dataclass(frozen=True)
class FoundQuality:
    """What a script's rate of mistakes is worth: 0 is chance, 1 the script without mistakes."""

    wanted: float
    measured: float
    chance_score: float
    """Mean score of random actions."""
    script_score: float
    """Mean score without mistakes."""
    episodes: int
    """By which each rate was measured."""

    def __str__(self) -> str:
        return (
            f"quality {self.measured:.2f} (wanted {self.wanted:g}) over {self.episodes} episodes, "
            f"where chance scores {self.chance_score:.2f} and the script {self.script_score:.2f}"
        )


@dataclass(frozen=True)
class SnapshotPlayed:
    """Which policy of which run demonstrated, and how it acted."""

    run: str
    version: int
    digest: str
    """SHA-256 of the weights."""
    epsilon: float
    """Probability of a random action; 0 for policies that sample by themselves."""

    def __post_init__(self) -> None:
        require_id("snapshot_played.run", self.run)
        require_count("snapshot_played.version", self.version)
        require_digest("snapshot_played.digest", self.digest)
        is_probability = 0 <= self.epsilon <= 1
        require(is_probability, "snapshot_played.epsilon", "a number in [0, 1]", self.epsilon)


@dataclass(frozen=True)
class ImportedDataset:
    """Which dataset demonstrations were imported from."""

    id: str
    """As the dataset calls itself, for example `door/human-v2`."""
    digest: str
    """SHA-256 of the file with its episodes."""
    algorithm: str = ""
    """Who or what acted, in the dataset's own words."""

    def __post_init__(self) -> None:
        require(bool(self.id), "imported_dataset.id", "a name", repr(self.id))
        require_digest("imported_dataset.digest", self.digest)


@dataclass(frozen=True)
class Demonstrator:
    """Who demonstrates: a task's script with mistakes, chance, a policy, or whoever others had."""

    kind: Literal["scripted", "random", "policy", "imported"]
    mistake_rate: float = 0.0
    """Share of the script's actions that are replaced by random ones."""
    quality: FoundQuality | None = None
    """For which the rate was found, where it was."""
    snapshot: SnapshotPlayed | None = None
    """Exactly with `policy`."""
    dataset: ImportedDataset | None = None
    """Exactly with `imported`."""

    def __post_init__(self) -> None:
        is_rate = 0 <= self.mistake_rate <= 1
        require(is_rate, "demonstrator.mistake_rate", "a number in [0, 1]", self.mistake_rate)
        is_script = self.kind == "scripted"
        has_mistakes = self.mistake_rate != 0 or self.quality is not None
        rule = "no mistakes and no quality except of a script"
        require(is_script or not has_mistakes, "demonstrator", rule, self)
        is_policy = self.kind == "policy"
        rule = "a snapshot exactly with 'policy'"
        require((self.snapshot is not None) == is_policy, "demonstrator.snapshot", rule, self)
        is_imported = self.kind == "imported"
        rule = "a dataset exactly with 'imported'"
        require((self.dataset is not None) == is_imported, "demonstrator.dataset", rule, self)

    def __str__(self) -> str:
        if self.snapshot is not None:
            played = self.snapshot
            chance = f", epsilon {played.epsilon:g}" if played.epsilon else ""
            return f"policy {played.version} of {played.run} ({played.digest[:12]}{chance})"
        if self.dataset is not None:
            said = f": {self.dataset.algorithm}" if self.dataset.algorithm else ""
            return f"dataset {self.dataset.id} ({self.dataset.digest[:12]}){said}"
        if self.kind == "random":
            return "chance"
        quality = f": {self.quality}" if self.quality else ""
        return f"the script, {self.mistake_rate:g} of its actions random{quality}"


@dataclass(frozen=True)
class DemonstrationsBegun:
    """Recording: from here on this demonstrator demonstrates; what came before is void."""

    demonstrator: Demonstrator
    draw: int
    """Counts how often all were drawn anew, for want of target states."""
    preset_json: str
    """Its task was played; its seed is the draw's."""
    software_version: str

    def __post_init__(self) -> None:
        require_count("demonstrations_begun.draw", self.draw)


@dataclass(frozen=True)
class TargetsMarked:
    """A person's word on which states of a demonstration are targets; the last one counts."""

    trajectory: TrajectoryId
    states: tuple[int, ...]
    """Indices into its T + 1 observations, from 1 on, ascending; none takes all marks back."""

    def __post_init__(self) -> None:
        pairs = itertools.pairwise((0, *self.states))
        is_sorted = all(before < state for before, state in pairs)
        require(is_sorted, "targets_marked.states", "ascending indices from 1 on", self.states)
