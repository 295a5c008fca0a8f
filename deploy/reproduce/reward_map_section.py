"""What a page says of the rewards that discriminators learn: figure 4.7."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from deploy.reproduce.experiment import Condition, Experiment
from deploy.reproduce.kept_weights import kept_discriminators, kept_policy
from deploy.reproduce.reward_map_figure import RewardLine, draw_maps, draw_scores
from deploy.reproduce.reward_maps import (
    MapScore,
    PoseGrid,
    best_pose_degrees,
    pose_grid,
    read_scores,
    reward_maps,
    score_map,
    write_scores,
)
from deploy.reproduce.runs import FinishedRun, RunKey, RunPlan
from deploy.reproduce.tables import mean_and_interval, table
from deploy.reproduce.work_folder import discriminators_file, policy_file
from deploy.rewards.timeline import draw_timelines, play_greedily, score_steps

MAPS: Final = "maps.png"
MAP_SCORES: Final = "map_scores.png"
NUMBERS: Final = "maps.jsonl"
TIMELINE: Final = "timeline.png"
NEAR_DEGREES: Final = 20.0
"""A peak nearer than this to the best pose counts as near: four steps of the grid."""


@dataclass(frozen=True)
class MappedRun:
    """A finished run, and what its discriminators rewarded."""

    condition: Condition
    plan: RunPlan
    maps: tuple[dict[str, NDArray[np.float64]], ...]
    """Of each iteration, from the first: see `reward_maps`."""

    @property
    def lines(self) -> list[RewardLine]:
        """Its rewards: of all discriminators together, then of each of two."""
        return [RewardLine(self.condition, part) for part in self.maps[0]]

    def scores(self, grid: PoseGrid) -> list[MapScore]:
        """Of all its maps."""
        return [
            score_map(self.plan, number, grid, part, rewards)
            for number, maps in enumerate(self.maps, start=1)
            for part, rewards in maps.items()
        ]


def map_rewards(
    experiment: Experiment, runs: Sequence[FinishedRun], work: Path, folder: Path
) -> list[str]:
    """Draws and scores what the discriminators of all runs reward; returns the page's sections.

    Of runs that have left their discriminators elsewhere it takes the numbers that the folder
    holds, and leaves the pictures as they are.

    Args:
        experiment: Reaching with two joints; each condition has discriminators.
        runs: That are finished.
        work: Folder in which the experiment keeps discriminators and policies.
        folder: Of the page; pictures and numbers are written into it.

    Raises:
        StorageError: There are neither discriminators nor numbers of a run.
        PresetError: The poses of the task are no plane.
    """
    iterations = {run.key: run.iterations for run in runs}
    finished = [it for it in _plans(experiment) if iterations.get(it[1].key)]
    if not finished:
        return []
    grid = pose_grid(finished[0][1].preset)
    mapped, scores = _mapped_and_scored(finished, iterations, grid, work, folder / NUMBERS)
    write_scores(folder / NUMBERS, scores)
    lines = list(
        dict.fromkeys(
            RewardLine(condition, score.part)
            for condition, plan in finished
            for score in scores
            if score.run == plan.key.name
        )
    )
    _draw_first_seed(folder / MAPS, grid, lines, mapped, scores)
    draw_scores(folder / MAP_SCORES, lines, scores)
    sections = [_maps_section(lines, scores, grid), _peaks_section(lines, scores)]
    with_policy = [run for run in mapped if policy_file(work, run.plan).exists()]
    if with_policy:  # a run that is to go on has left none yet
        _draw_timeline(folder, with_policy[0], work)
    if (folder / TIMELINE).exists():
        sections.append(_timeline_section(*finished[0]))
    return sections


def _mapped_and_scored(
    finished: Sequence[tuple[Condition, RunPlan]],
    iterations: Mapping[RunKey, int],
    grid: PoseGrid,
    work: Path,
    numbers: Path,
) -> tuple[list[MappedRun], list[MapScore]]:
    """Maps of the runs that have left their discriminators; scores of all, from the file if not."""
    known = read_scores(numbers)
    mapped: list[MappedRun] = []
    scores: list[MapScore] = []
    for condition, plan in finished:
        last = iterations[plan.key]
        its = [it for it in known if it.run == plan.key.name and it.iteration <= last]
        is_known = any(it.iteration == last for it in its)
        if not is_known or discriminators_file(work, plan, last).exists():
            mapped.append(_mapped(condition, plan, last, grid, work))
            its = mapped[-1].scores(grid)
        scores += its
    return mapped, scores


def _draw_first_seed(
    path: Path,
    grid: PoseGrid,
    lines: Sequence[RewardLine],
    mapped: Sequence[MappedRun],
    scores: Sequence[MapScore],
) -> None:
    """Draws the maps of the first seed, if all of them are there; else leaves the picture."""
    seed = scores[0].seed
    rows = {
        line: [maps[line.part] for maps in run.maps]
        for run in mapped
        if run.plan.key.seed == seed
        for line in run.lines
    }
    if rows.keys() == set(lines):
        draw_maps(path, grid, rows, [it for it in scores if it.seed == seed])


def _plans(experiment: Experiment) -> list[tuple[Condition, RunPlan]]:
    return [
        (condition, experiment.plan(panel, condition, seed))
        for panel in experiment.panels
        for condition in panel.conditions
        for seed in panel.seed_numbers
    ]


def _mapped(
    condition: Condition, plan: RunPlan, iterations: int, grid: PoseGrid, work: Path
) -> MappedRun:
    maps = tuple(
        reward_maps(plan.preset, kept_discriminators(work, plan, iteration), grid)
        for iteration in range(1, iterations + 1)
    )
    return MappedRun(condition, plan, maps)


def _draw_timeline(folder: Path, run: MappedRun, work: Path) -> None:
    """The last policy's episode, under the discriminators of an early and of the last iteration."""
    last = len(run.maps)
    played = play_greedily(run.plan.preset, kept_policy(work, run.plan))
    timelines = [
        score_steps(
            f"{run.condition.label}, discriminators of iteration {iteration}",
            run.plan.preset,
            kept_discriminators(work, run.plan, iteration),
            played,
        )
        for iteration in dict.fromkeys((min(2, last), last))
    ]
    draw_timelines(folder / TIMELINE, timelines)


def _timeline_section(condition: Condition, plan: RunPlan) -> str:
    return "\n\n".join(
        (
            "### The rewards of one episode",
            f"![Rewards over the steps of an episode, beside its pictures]({TIMELINE})",
            f"What discriminators make of the state after each step: {condition.label}, seed "
            f"{plan.key.seed}, the greedy episode of the policy after all "
            f"{plan.preset.schedule.iterations} iterations.",
        )
    )


def _maps_section(lines: Sequence[RewardLine], scores: Sequence[MapScore], grid: PoseGrid) -> str:
    first, second = best_pose_degrees()
    return "\n\n".join(
        (
            "## What discriminators reward",
            f"![Reward maps, a row for each reward, a column for each iteration]({MAPS})",
            f"Rewards of seed {min(it.seed for it in scores)} over both joint angles, for the "
            "discriminators that labelled each iteration's samples; above each map its rank "
            "correlation (Spearman's) with the task's reward. Every map has its own colours, dark "
            "where it is lowest. Red cross: the best "
            f"pose, {first:.0f} and {second:.0f} degrees. Black ring: where the map is highest. "
            "Left and below of the dashed line is what an episode can reach. Rewards are those of "
            "eq. 4.3, without the bound that the generator's have.",
            f"![Rank correlations and peaks over iterations]({MAP_SCORES})",
            _correlation_table(lines, scores),
            f"Poses: 0 to {grid.degrees[-1]:.0f} degrees in steps of "
            f"{grid.degrees[1] - grid.degrees[0]:g}, each joint.",
        )
    )


def _correlation_table(lines: Sequence[RewardLine], scores: Sequence[MapScore]) -> str:
    header = ["reward", "seeds", "rank correlation, all iterations", "95 %", "last iteration"]
    header += ["95 %", "reachable poses, all iterations", "95 %"]
    rows = []
    for line in lines:
        seeds = line.seeds(scores)
        rows.append(
            [
                line.label,
                str(len(seeds)),
                *_cells([np.mean([it.rank_correlation for it in seed]) for seed in seeds]),
                *_cells([seed[-1].rank_correlation for seed in seeds]),
                *_cells(
                    [np.mean([it.reachable_rank_correlation for it in seed]) for seed in seeds]
                ),
            ]
        )
    return table(header, rows)


def _cells(values: Sequence[float | np.floating]) -> list[str]:
    return mean_and_interval([float(value) for value in values], "{:+.2f}")


def _peaks_section(lines: Sequence[RewardLine], scores: Sequence[MapScore]) -> str:
    n_iterations = max(score.iteration for score in scores)
    header = ["reward", "seed", *(str(number + 1) for number in range(n_iterations))]
    rows = []
    for line in lines:
        for seed in line.seeds(scores):
            peaks = [f"{it.peak_degrees[0]:.0f}, {it.peak_degrees[1]:.0f}" for it in seed]
            missing = [""] * (n_iterations - len(peaks))
            rows.append([line.label, str(seed[0].seed), *peaks, *missing])
    distances = ["reward", "mean distance", "95 %", "largest", f"within {NEAR_DEGREES:g} degrees"]
    distances += ["the task's reward there", "95 %"]
    summary = []
    for line in lines:
        seeds = line.seeds(scores)
        errors = [float(np.mean([it.peak_error_degrees for it in seed])) for seed in seeds]
        rewards = [float(np.mean([it.peak_reward for it in seed])) for seed in seeds]
        every = [it.peak_error_degrees for seed in seeds for it in seed]
        n_near = sum(error <= NEAR_DEGREES for error in every)
        summary.append(
            [
                line.label,
                *mean_and_interval(errors, "{:.0f}"),
                f"{max(every):.0f}",
                f"{n_near} of {len(every)}",
                *mean_and_interval(rewards, "{:.2f}"),
            ]
        )
    first, second = best_pose_degrees()
    return "\n\n".join(
        (
            "### Where rewards are highest",
            f"Distance from the best pose, {first:.0f} and {second:.0f} degrees, over all "
            "iterations; the task's reward is 0 there and -1.68 upright.",
            table(distances, summary),
            "Both joint angles in degrees, iteration by iteration:",
            table(header, rows),
        )
    )
