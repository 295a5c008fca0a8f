"""Maps of the rewards that discriminators give over all poses of an arm with two joints.

Source: figure 4.7.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, cast

import numpy as np
import torch
from numpy.typing import NDArray

from actors.envs.planar_arm import INCREMENTS_RAD, TARGET_M, end_effector_m, reaching_reward
from actors.envs.reaching import observe_arm
from actors.envs.reaching_picture import Colour
from broker_config.errors import PresetError
from broker_config.preset import Preset
from deploy.reproduce.json_lines import read_lines, write_lines
from deploy.reproduce.runs import RunPlan
from deploy.reproduce.statistics import rank_correlation
from discriminator.rewards import discriminator_reward
from discriminator.stored import StoredDiscriminators

_UNBOUNDED: Final = float("inf")


@dataclass(frozen=True)
class PoseGrid:
    """Poses of an arm with two joints, at equal distances."""

    degrees: NDArray[np.float64]
    """Of either joint, f64[n]."""
    colour: Colour
    """As the task draws the arm."""
    horizon: int
    """Steps of an episode, which begins upright and turns one joint a step."""

    @cached_property
    def angles_rad(self) -> NDArray[np.float64]:
        """f64[n, n, 2]: the first joint goes with the first axis."""
        one = np.deg2rad(self.degrees)
        return np.stack(np.meshgrid(one, one, indexing="ij"), axis=-1)

    @cached_property
    def pictures(self) -> torch.Tensor:
        """What the policy sees in each pose, u8[n * n, 84, 84, C]."""
        poses = self.angles_rad.reshape(-1, 2)
        return torch.from_numpy(np.stack([observe_arm(pose, self.colour) for pose in poses]))

    @cached_property
    def true_rewards(self) -> NDArray[np.float64]:
        """Of the task, f64[n, n]."""
        return reaching_reward(end_effector_m(self.angles_rad))

    @cached_property
    def reachable(self) -> NDArray[np.bool_]:
        """Whether an episode is long enough to get there, bool[n, n]."""
        most_rad = self.horizon * max(INCREMENTS_RAD)
        return np.asarray(np.abs(self.angles_rad).sum(axis=-1) <= most_rad)


def has_pose_grid(preset: Preset) -> bool:
    """Whether the task is reaching with two joints, whose poses are a plane."""
    task = preset.task
    return task.environment == "clothbus/Reaching-v0" and task.options.get("n_joints") == 2


def pose_grid(preset: Preset, step_degrees: float = 5.0) -> PoseGrid:
    """From upright to as far as one joint alone can turn in an episode.

    Raises:
        PresetError: The task is not reaching with two joints.
    """
    task = preset.task
    if not has_pose_grid(preset):
        raise PresetError(
            f"{preset.name}: expected reaching with two joints, whose poses are a plane; got "
            f"{task.environment} with {dict(task.options)}; set task.options.n_joints=2"
        )
    most_degrees = np.rad2deg(task.horizon * max(INCREMENTS_RAD))
    degrees = np.arange(0.0, most_degrees, step_degrees)
    colour = cast(Colour, task.options.get("colour", "grayscale"))
    return PoseGrid(degrees, colour, task.horizon)


def best_pose_degrees() -> tuple[float, float]:
    """The angles of two joints that put the end effector on the target: about 43 and 94 degrees.

    The arm and the line from its base to the target are a triangle with two sides of 1 / 2.
    """
    bend_rad = 2 * np.arccos(np.linalg.norm(TARGET_M))
    towards_target_rad = np.arctan2(TARGET_M[0], TARGET_M[1])
    return float(np.rad2deg(towards_target_rad - bend_rad / 2)), float(np.rad2deg(bend_rad))


def reward_maps(preset: Preset, weights: bytes, grid: PoseGrid) -> dict[str, NDArray[np.float64]]:
    """-log(1 - D) over all poses, f64[n, n]: "all" (eq. 4.3), and each of two discriminators.

    Bounds are not applied: they would make a plain of what is highest.

    Args:
        preset: Of the run.
        weights: Of its discriminators, as snapshots have them.
        grid: The poses.

    Raises:
        DecodeError: The weights are not those of the preset's discriminators.
    """
    logits = StoredDiscriminators(preset, weights).logits(grid.pictures)
    maps = {
        name: discriminator_reward(each, _UNBOUNDED).double().numpy().reshape(grid.reachable.shape)
        for name, each in logits.items()
    }
    parts = maps if len(maps) > 1 else {}
    return {"all": np.sum(list(maps.values()), axis=0), **parts}


@dataclass(frozen=True)
class MapScore:
    """How well a reward map agrees with the task's reward."""

    run: str
    condition: str
    seed: int
    iteration: int
    part: str
    """all, expert or target: whose reward."""
    rank_correlation: float
    """Spearman's, with the task's reward over all poses of the grid."""
    reachable_rank_correlation: float
    """The same over the poses that an episode can reach."""
    peak_degrees: tuple[float, float]
    """Where the map is highest."""
    peak_reward: float
    """The task's reward there; the best is 0."""

    @property
    def peak_error_degrees(self) -> float:
        """How far the peak is from the best pose, in the plane of both angles."""
        return math.dist(self.peak_degrees, best_pose_degrees())


def score_map(
    plan: RunPlan, iteration: int, grid: PoseGrid, part: str, rewards: NDArray[np.float64]
) -> MapScore:
    """Compares one of `reward_maps` with the task's reward."""
    first, second = np.unravel_index(int(rewards.argmax()), rewards.shape)
    inside = grid.reachable
    return MapScore(
        run=plan.key.name,
        condition=plan.key.condition,
        seed=plan.key.seed,
        iteration=iteration,
        part=part,
        rank_correlation=rank_correlation(rewards.ravel(), grid.true_rewards.ravel()),
        reachable_rank_correlation=rank_correlation(rewards[inside], grid.true_rewards[inside]),
        peak_degrees=(float(grid.degrees[first]), float(grid.degrees[second])),
        peak_reward=float(grid.true_rewards[first, second]),
    )


def read_scores(path: Path) -> list[MapScore]:
    """Reads what `write_scores` wrote; no scores where there is no file.

    Raises:
        StorageError: The file holds something else.
    """
    return read_lines(path, MapScore, "scores of reward maps")


def write_scores(path: Path, scores: Iterable[MapScore]) -> None:
    """Writes the scores; a reader sees the whole file or none.

    Raises:
        StorageError: The disk refuses.
    """
    write_lines(path, scores)
