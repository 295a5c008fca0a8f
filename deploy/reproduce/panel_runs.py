"""The finished runs of an experiment, sorted into its panels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import mean

from deploy.reproduce.experiment import Condition, Experiment, Measure, Panel
from deploy.reproduce.runs import CLONED, FinishedRun, RunKey
from deploy.reproduce.statistics import PairedDifference, area_under_curve, paired_difference
from deploy.reproduce.stored_scores import StoredScore, states_of


@dataclass(frozen=True)
class PanelRuns:
    """A panel, and those of its runs that are finished."""

    panel: Panel
    runs: dict[str, list[FinishedRun]]
    """By condition, in the order of seeds."""
    measure: Measure = "greedy_returns"
    """Under which areas are taken."""
    scores: dict[str, list[StoredScore]] = field(default_factory=dict)
    """Of last policies on the panel's stored states, by condition."""

    @property
    def subject(self) -> Condition:
        """The condition that the others are compared with."""
        return self.panel.conditions[0]

    def areas(self, condition: Condition) -> dict[int, float]:
        """Area under the curve of the measure, by seed."""
        return {
            run.key.seed: area_under_curve(run.samples, getattr(run, self.measure))
            for run in self.runs[condition.name]
        }

    def mean_area(self, condition: Condition) -> float:
        """Over the seeds."""
        return mean(self.areas(condition).values())

    def last_values(self, condition: Condition) -> dict[int, float]:
        """The measure of the last policy, by seed."""
        return {run.key.seed: getattr(run, self.measure)[-1] for run in self.runs[condition.name]}

    def best(self) -> Condition | None:
        """The condition with the largest mean area; None while runs of a condition are missing."""
        if any(len(runs) < self.panel.seeds for runs in self.runs.values()):
            return None
        return max(self.panel.conditions, key=self.mean_area)

    def difference(self, other: Condition) -> PairedDifference | None:
        """The subject minus the other, over the seeds that both have finished.

        Areas are compared; with what was cloned, which has no curve, the last policies.
        """
        values = self.last_values if other.start in CLONED else self.areas
        return _paired(values(self.subject), values(other))

    def training_difference(self, other: Condition) -> PairedDifference | None:
        """The same of the mean return of all that was played to learn; None if one played nothing.

        What a learner's exploration costs counts here, and does not in `difference`.
        """
        return _paired(self._training_means(self.subject), self._training_means(other))

    def _training_means(self, condition: Condition) -> dict[int, float]:
        by_seed = {
            run.key.seed: [value for value in run.training_returns if value is not None]
            for run in self.runs[condition.name]
        }
        return {seed: mean(returns) for seed, returns in by_seed.items() if returns}

    def demonstrated_returns(self) -> dict[int, float]:
        """Mean return of what was demonstrated to the runs, by seed."""
        returns = {
            run.key.seed: demonstrated
            for condition in self.panel.conditions
            for run in self.runs[condition.name]
            if (demonstrated := run.demonstrated_return) is not None
        }
        return dict(sorted(returns.items()))

    def above_demonstrations(self, condition: Condition) -> PairedDifference | None:
        """The last policy's return minus the mean return of what was demonstrated to it."""
        pairs = [
            (run.greedy_returns[-1], demonstrated)
            for run in self.runs[condition.name]
            if (demonstrated := run.demonstrated_return) is not None
        ]
        if not pairs:
            return None
        return paired_difference([its for its, _ in pairs], [theirs for _, theirs in pairs])


def _paired(mine: Mapping[int, float], theirs: Mapping[int, float]) -> PairedDifference | None:
    """Over the seeds that both have."""
    seeds = sorted(mine.keys() & theirs.keys())
    if not seeds:
        return None
    return paired_difference([mine[it] for it in seeds], [theirs[it] for it in seeds])


def sort_runs(
    experiment: Experiment, runs: Sequence[FinishedRun], scores: Sequence[StoredScore] = ()
) -> list[PanelRuns]:
    """The finished runs and their scores, by panel and condition."""
    by_key: dict[RunKey, FinishedRun] = {run.key: run for run in runs}
    sorted_runs = []
    for panel in experiment.panels:
        keys = {
            condition.name: [
                experiment.plan(panel, condition, seed).key for seed in panel.seed_numbers
            ]
            for condition in panel.conditions
        }
        found = {name: [by_key[key] for key in its if key in by_key] for name, its in keys.items()}
        scored: dict[str, list[StoredScore]] = {}
        if panel.stored_states is not None:
            digest = states_of(panel.stored_states).digest
            on_these = [score for score in scores if score.states_digest == digest]
            scored = {
                name: [score for score in on_these if score.run in its]
                for name, its in keys.items()
            }
        sorted_runs.append(PanelRuns(panel, found, experiment.measures[0], scored))
    return sorted_runs
