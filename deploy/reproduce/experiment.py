"""What an experiment is: conditions that are compared on the same seeds, panel by panel."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from broker_config.errors import PresetError
from broker_config.preset import Preset
from deploy.presets import load_preset
from deploy.reproduce.runs import RunKey, RunPlan

Start = Literal["untrained", "initialised", "cloned"]
"""How a run begins: with the untrained policy, by Algorithm 2 from demonstrations, or by supervised
learning of demonstrations, which is all that is learned then."""

Measure = Literal["greedy_returns", "greedy_successes", "relative_bellman_errors"]


@dataclass(frozen=True)
class Condition:
    """One line of a figure."""

    name: str
    """Short, for files."""
    label: str
    colour: str
    overrides: tuple[str, ...]
    """Settings that replace the preset's."""
    start: Start = "untrained"


@dataclass(frozen=True)
class Panel:
    """Conditions that are compared with each other: one figure's axes and one table."""

    title: str
    conditions: tuple[Condition, ...]
    """The first is compared with each of the others."""
    seeds: int
    """Seeds 0, 1, ... are given to every condition."""
    overrides: tuple[str, ...] = ()
    mistake_rate: float | None = None
    """Of its demonstrations; the experiment's if None."""


@dataclass(frozen=True)
class Experiment:
    """A figure of the source, or one beside it."""

    name: str
    title: str
    source: str
    """What of the source it reproduces."""
    published: str
    """What the source says came out."""
    preset: str
    panels: tuple[Panel, ...]
    overrides: tuple[str, ...] = ()
    measures: tuple[Measure, ...] = ("greedy_returns",)
    """Each is a row of the figure; areas are taken under the first."""
    episodes: int = 1
    """Of the greedy policy after each update; 1 is exact where task and start are deterministic."""
    mistake_rate: float = 0.0
    """Share of the demonstrator's actions that are random."""
    notes: tuple[str, ...] = ()
    """What a reader must know of the settings."""
    changes: tuple[str, ...] = ()
    """Settings that somebody has replaced, whatever the experiment says."""

    def preset_of(self, panel: Panel, condition: Condition, seed: int) -> Preset:
        """The preset of one run.

        Raises:
            PresetError: There is no such preset, or an override cannot be used.
        """
        made = (*self.overrides, *panel.overrides, *condition.overrides)
        overrides = (*made, *self.changes, f"seed={seed}")
        preset = load_preset(self.preset, overrides)
        if condition.start == "untrained":
            return dataclasses.replace(preset, initialisation=None)
        return preset

    def plan(self, panel: Panel, condition: Condition, seed: int) -> RunPlan:
        """All that determines one run."""
        preset = self.preset_of(panel, condition, seed)
        needs_none = condition.start == "untrained" and preset.imitation is None
        rate = None if needs_none else self._mistake_rate_of(panel)
        key = RunKey(condition.name, seed, preset.digest, condition.start, rate, self.episodes)
        return RunPlan(key, preset)

    def _mistake_rate_of(self, panel: Panel) -> float:
        return self.mistake_rate if panel.mistake_rate is None else panel.mistake_rate

    def plans(self) -> Iterator[RunPlan]:
        """All runs, seed by seed: what is finished first can be compared first."""
        for seed in range(max(panel.seeds for panel in self.panels)):
            for panel in self.panels:
                if seed < panel.seeds:
                    for condition in panel.conditions:
                        yield self.plan(panel, condition, seed)


@dataclass(frozen=True)
class AttentionFigure:
    """What the last policies of an experiment look at, as Grad-CAM shows it."""

    name: str
    title: str
    source: str
    published: str
    experiment: str
    """Whose policies they are."""
    conditions: tuple[str, ...]
    seed: int = 0
    steps: int = 4


def with_changes(
    experiment: Experiment,
    seeds: int | None = None,
    overrides: Sequence[str] = (),
    conditions: Sequence[str] = (),
) -> Experiment:
    """The experiment with fewer or more seeds, other settings, or some of its conditions alone.

    Raises:
        PresetError: There is no condition of a name.
    """
    names = {condition.name for panel in experiment.panels for condition in panel.conditions}
    if unknown := [name for name in conditions if name not in names]:
        raise PresetError(
            f"{experiment.name}: expected conditions of {', '.join(sorted(names))}; got "
            f"{unknown[0]}; choose among them"
        )
    panels = []
    for panel in experiment.panels:
        chosen = [it for it in panel.conditions if not conditions or it.name in conditions]
        if chosen:
            n_seeds = panel.seeds if seeds is None else seeds
            panels.append(dataclasses.replace(panel, seeds=n_seeds, conditions=tuple(chosen)))
    return dataclasses.replace(
        experiment, panels=tuple(panels), changes=(*experiment.changes, *overrides)
    )
