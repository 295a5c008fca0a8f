"""`clothbus attention`: what a policy looks at, picture by picture (figures 3.12 and 4.13)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from actors.acting import Greedy
from actors.cloth.masks import cloth_mask
from actors.policy import Policy
from actors.rollout import Start, rollout
from actors.task import make_task_env
from broker_config.preset import Preset
from learner.tickets import make_ticket

mpl.use("Agg")  # before pyplot: there is no screen
from matplotlib import pyplot as plt

_HEAT_SHARE = 0.45
"""Of the colours; the rest is the picture."""
_STEP_INCHES = 1.6


@dataclass(frozen=True)
class AttendedStep:
    """A picture, the action that was chosen on it, and what spoke for it."""

    picture: NDArray[np.uint8]
    """u8[H, W, C]."""
    action: int
    heat: NDArray[np.float32]
    """f32[H, W] in 0...1."""
    reward: float

    @property
    def heat_on_cloth(self) -> float:
        """Portion of the heat that lies on cloth; nan where there is no heat."""
        total = float(self.heat.sum())
        return float(self.heat[cloth_mask(self.picture)].sum()) / total if total else math.nan

    @property
    def cloth_share(self) -> float:
        """Portion of the picture that shows cloth: what heat would have on it by chance."""
        return float(cloth_mask(self.picture).mean())


def attend(preset: Preset, policy: Policy, episode: int, steps: int) -> list[AttendedStep]:
    """Plays the beginning of an episode greedily, and asks at each step what speaks for the action.

    Args:
        preset: Whose task is played.
        policy: Which acts.
        episode: Names the seed, as a run's episodes do.
        steps: How many, at most.

    Raises:
        PresetError: Task and preset disagree.
    """
    attended: list[AttendedStep] = []
    with closing(make_task_env(preset.task)) as env:
        events = rollout(env, Greedy(policy), make_ticket(preset, episode))
        start = next(events)
        assert isinstance(start, Start)
        picture = start.observation
        for step in events:
            assert not isinstance(step, Start)
            heat = policy.attention(picture, step.action)
            attended.append(AttendedStep(picture, step.action, heat, step.reward))
            picture = step.observation
            if len(attended) == steps:
                break
    return attended


def draw_attention(path: Path, title: str, rows: Sequence[tuple[str, list[AttendedStep]]]) -> None:
    """Draws each policy's steps as two lines of pictures: as seen, and what spoke for the action.

    Args:
        path: Of the PNG.
        title: Above the figure.
        rows: A label and the steps of each policy.
    """
    n_columns = max(len(steps) for _, steps in rows)
    size = (_STEP_INCHES * n_columns + 0.6, 2 * _STEP_INCHES * len(rows) + 0.5)
    figure, grid = plt.subplots(
        2 * len(rows), n_columns, figsize=size, layout="constrained", squeeze=False
    )
    for axis in grid.flat:
        axis.set(xticks=[], yticks=[])
        axis.set_frame_on(False)
    for number, (label, steps) in enumerate(rows):
        grid[2 * number][0].set_ylabel(label, fontsize=8)
        for column, step in enumerate(steps):
            above, below = grid[2 * number][column], grid[2 * number + 1][column]
            above.set_title(f"{column + 1}: action {step.action}, {step.reward:.2f}", fontsize=7)
            above.imshow(_as_rgb(step.picture))
            below.imshow(with_heat(step.picture, step.heat))
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def with_heat(picture: NDArray[np.uint8], heat: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Lays heat over a picture.

    Args:
        picture: u8[H, W, C].
        heat: f32[H, W] in 0...1.

    Returns:
        u8[H, W, 3], RGB.
    """
    coloured = cv2.applyColorMap((255 * heat).astype(np.uint8), cv2.COLORMAP_JET)[..., ::-1]
    mixed = (1 - _HEAT_SHARE) * _as_rgb(picture) + _HEAT_SHARE * coloured
    return np.asarray(mixed.round().astype(np.uint8))


def _as_rgb(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.broadcast_to(picture, (*picture.shape[:2], 3))
