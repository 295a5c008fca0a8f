"""What an experiment is: conditions that are compared on the same seeds, panel by panel."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from broker_config.errors import PresetError
from broker_config.preset import Preset
from deploy.presets import load_preset
from deploy.reproduce.runs import RunKey, RunPlan, ScoredAfter, Start
from learner.steps.compute import TrainingPath

DEMONSTRATOR: Final = "demonstrator"
"""The condition of runs that learn to demonstrate."""

Measure = Literal[
    "greedy_returns", "greedy_successes", "training_returns", "relative_bellman_errors"
]


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
    path: TrainingPath | None = None
    """By which its learners make gradient steps; what the command asks for if None."""


@dataclass(frozen=True)
class PolicyUnderTraining:
    """A demonstrator that has learned for a while, from the task's own rewards."""

    updates: int
    """Iterations, which end with an update, after which it demonstrates."""
    overrides: tuple[str, ...]
    """Settings by which it learns, beside those of the panel."""


@dataclass(frozen=True)
class Panel:
    """Conditions that are compared with each other: one figure's axes and one table."""

    title: str
    conditions: tuple[Condition, ...]
    """The first is compared with each of the others."""
    seeds: int
    """How many are given to every condition, the same to each."""
    overrides: tuple[str, ...] = ()
    mistake_rate: float | None = None
    """Of its demonstrations; the experiment's if None."""
    demonstrator: PolicyUnderTraining | None = None
    """Who demonstrates; the task's script, with mistakes, if None."""
    preset: str | None = None
    """The experiment's if None."""
    stored_states: str | None = None
    """Where last policies are scored, too; see `actors.envs.stored_states.read_stored_states`."""
    first_seed: int = 0
    tries_settings: bool = False
    """Whether the conditions are settings of one method, of which the best is chosen."""

    @property
    def seed_numbers(self) -> range:
        """The seeds themselves."""
        return range(self.first_seed, self.first_seed + self.seeds)


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
    """Each is a row of the figure; areas are taken under the first, which is a greedy one."""
    episodes: int = 1
    """Of the greedy policy for a score; 1 is exact where task and start are deterministic."""
    scored_after: ScoredAfter = "update"
    mistake_rate: float = 0.0
    """Share of the demonstrator's actions that are random."""
    notes: tuple[str, ...] = ()
    """What a reader must know of the settings."""
    has_reward_maps: bool = False
    """Whether what its discriminators reward is drawn over all poses of an arm with two joints."""
    changes: tuple[str, ...] = ()
    """Settings that somebody has replaced, whatever the experiment says."""

    def preset_of(self, panel: Panel, condition: Condition, seed: int) -> Preset:
        """The preset of one run.

        Raises:
            PresetError: There is no such preset, or an override cannot be used.
        """
        made = (*self.overrides, *panel.overrides, *condition.overrides)
        overrides = (*made, *self.changes, f"seed={seed}")
        preset = load_preset(self.preset_name(panel), overrides)
        if condition.start in ("untrained", "pretrained"):
            return dataclasses.replace(preset, initialisation=None)
        return preset

    def preset_name(self, panel: Panel) -> str:
        """What a panel's runs begin from."""
        return self.preset if panel.preset is None else panel.preset

    def plan(self, panel: Panel, condition: Condition, seed: int) -> RunPlan:
        """All that determines one run."""
        preset = self.preset_of(panel, condition, seed)
        needs_none = condition.start == "untrained" and preset.imitation is None
        demonstrator = None if needs_none else self.demonstrator_plan(panel, seed)
        by_script = not needs_none and demonstrator is None
        key = RunKey(
            condition.name,
            seed,
            preset.digest,
            condition.start,
            self._mistake_rate_of(panel) if by_script else None,
            self.episodes,
            None if demonstrator is None else demonstrator.key.name,
            self.scored_after,
        )
        return RunPlan(key, preset, condition.path, demonstrator)

    def demonstrator_plan(self, panel: Panel, seed: int) -> RunPlan | None:
        """The run whose last policy demonstrates to a panel's runs of a seed.

        Returns:
            None where the task's script demonstrates.
        """
        if panel.demonstrator is None:
            return None
        made = (*self.overrides, *panel.overrides, *self.changes)
        # Last: what the panel says of it holds. Other changes are its own, too.
        its_own = (
            *panel.demonstrator.overrides,
            f"schedule.iterations={panel.demonstrator.updates}",
        )
        learned = load_preset(self.preset_name(panel), (*made, *its_own, f"seed={seed}"))
        preset = dataclasses.replace(learned, imitation=None, initialisation=None)
        key = RunKey(
            DEMONSTRATOR,
            seed,
            preset.digest,
            "untrained",
            None,
            self.episodes,
            scored_after=self.scored_after,
        )
        return RunPlan(key, preset)

    def _mistake_rate_of(self, panel: Panel) -> float:
        return self.mistake_rate if panel.mistake_rate is None else panel.mistake_rate

    def plans(self) -> Iterator[RunPlan]:
        """All runs, seed by seed: what is finished first can be compared first.

        A run that several panels show is made once.
        """
        planned = set()
        for number in range(max(panel.seeds for panel in self.panels)):
            for panel in self.panels:
                if number < panel.seeds:
                    for condition in panel.conditions:
                        plan = self.plan(panel, condition, panel.seed_numbers[number])
                        if plan.key not in planned:
                            planned.add(plan.key)
                            yield plan


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
    panels: tuple[str, ...] = ()
    """Titles of those whose policies are drawn; all if none is named."""
    steps: int = 4


@dataclass(frozen=True)
class World:
    """Where policies are tested that have learned elsewhere."""

    label: str
    overrides: tuple[str, ...] = ()
    """Settings that make it of the world in which they have learned."""


@dataclass(frozen=True)
class KeptPolicies:
    """Last policies of one panel of an experiment."""

    experiment: str
    panel: str
    conditions: tuple[str, ...]
    """Names."""


@dataclass(frozen=True)
class TransferTable:
    """How last policies of experiments do in worlds that they have not learned in."""

    name: str
    title: str
    source: str
    published: str
    policies: tuple[KeptPolicies, ...]
    worlds: tuple[World, ...]
    """The first is that in which they have learned."""
    episodes: int = 10
    """Greedy ones, of each policy in each world, on seeds that no run learns from."""
    notes: tuple[str, ...] = ()


def with_changes(
    experiment: Experiment,
    seeds: int | None = None,
    overrides: Sequence[str] = (),
    conditions: Sequence[str] = (),
    panels: Sequence[str] = (),
) -> Experiment:
    """The experiment with fewer or more seeds, other settings, or a part of its comparisons alone.

    Raises:
        PresetError: There is no condition or no panel of a name, or none of both.
    """
    names = {condition.name for panel in experiment.panels for condition in panel.conditions}
    _require_known(experiment, "conditions", conditions, names)
    titles = {panel.title for panel in experiment.panels}
    _require_known(experiment, "panels", panels, titles)
    kept = []
    for panel in experiment.panels:
        chosen = [it for it in panel.conditions if not conditions or it.name in conditions]
        if chosen and (not panels or panel.title in panels):
            n_seeds = panel.seeds if seeds is None else seeds
            kept.append(dataclasses.replace(panel, seeds=n_seeds, conditions=tuple(chosen)))
    if not kept:
        raise PresetError(
            f"{experiment.name}: expected conditions of the panels that are asked for; got none "
            f"of {', '.join(conditions)} in {', '.join(panels)}; leave one of both out"
        )
    return dataclasses.replace(
        experiment, panels=tuple(kept), changes=(*experiment.changes, *overrides)
    )


def _require_known(
    experiment: Experiment, what: str, asked: Sequence[str], known: Iterable[str]
) -> None:
    if unknown := [name for name in asked if name not in known]:
        raise PresetError(
            f"{experiment.name}: expected {what} of {', '.join(sorted(known))}; got {unknown[0]}; "
            "choose among them"
        )
