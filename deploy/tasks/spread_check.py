"""The self-test of the automatic reset: crumpled handkerchiefs must come to lie spread again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.table import Table

from actors.cloth.camera import Camera
from actors.cloth.masks import Side, cloth_mask, red_mask
from actors.cloth.measures import FAR_ABOVE, true_coverage
from actors.cloth.pulls import Pull
from actors.cloth.rasteriser import draw_cloth
from actors.cloth.spreading import SpreadAim, SpreadEnd
from actors.envs import ClothTaskEnv, make_env
from actors.envs.initial_states import check_initial_state
from deploy.evaluation.played_episodes import mapped

SPREAD_COVERAGE: Final = 0.9
"""True normalised coverage above which a handkerchief is back."""

LEAST_SPREAD: Final = 0.9
"""Portion of the episodes of each state that must come back."""

STRIP_COLUMNS: Final = 6
TILE_PX: Final = 168
_ARROW = (255, 255, 255)


@dataclass(frozen=True)
class Trial:
    """Where handkerchiefs are spread, and what is asked of the rule."""

    env_id: str
    options: Mapping[str, Any]
    """Keywords of the environment."""

    size_px: int = 84
    """Width of the pictures that the rule sees."""

    up: Side | None = None
    """The side that must be up in the end; None: either."""

    def __str__(self) -> str:
        options = {**self.options, "size_px": self.size_px, "up": self.up or "either"}
        return f"{self.env_id}: " + ", ".join(f"{name}={it}" for name, it in options.items())

    @property
    def aim(self) -> SpreadAim:
        """When to stop."""
        return SpreadAim(up=self.up)

    def check(self) -> None:
        """Tell here, and not in a worker, what is wrong.

        Raises:
            ValueError: there is no such task or option, or its garment cannot be spread.
        """
        make_env(self.env_id, **{**self.options, "automatic_reset": True}).close()

    def made(self, **further: Any) -> ClothTaskEnv:
        """The environment, which lays each handkerchief anew."""
        env = make_env(self.env_id, **{**self.options, **further}).unwrapped
        assert isinstance(env, ClothTaskEnv), "only they have automatic_reset"
        return env


@dataclass(frozen=True)
class SpreadEpisode:
    """How one handkerchief was spread; what is true comes from the simulator's vertices."""

    coverage_at_start: float
    coverage_at_end: float
    off_middle_m: float
    is_red: bool
    """Whether most of what is seen in the end is."""

    actions: int
    end: SpreadEnd

    @property
    def is_back(self) -> bool:
        """Whether it lies spread, whatever the rule believes."""
        return self.coverage_at_end > SPREAD_COVERAGE


@dataclass(frozen=True)
class SpreadCheck:
    """What the automatic reset achieves from each state."""

    trial: Trial
    episodes: Mapping[str, Sequence[SpreadEpisode]]
    """By state."""

    @property
    def holds(self) -> bool:
        """Whether enough came back from each state."""
        return all(_rate(them) >= LEAST_SPREAD for them in self.episodes.values())

    def table(self) -> Table:
        """For the console."""
        table = Table("", *self.episodes, title=f"Spreading, {self.trial}")
        columns = list(self.episodes.values())
        table.add_row("episodes", *(str(len(them)) for them in columns))
        table.add_row(
            f"back above {SPREAD_COVERAGE:g}", *(f"{_rate(them):.0%}" for them in columns)
        )
        table.add_row("actions: mean, median, 95 %", *map(_actions, columns))
        table.add_row(
            "coverage at the start: 2 %, median, 98 %",
            *(_quantiles([it.coverage_at_start for it in them]) for them in columns),
        )
        table.add_row(
            "coverage at the end: 2 %, median, 98 %",
            *(_quantiles([it.coverage_at_end for it in them]) for them in columns),
        )
        table.add_row(
            "off the middle, mm: 2 %, median, 98 %",
            *(_quantiles([1e3 * it.off_middle_m for it in them], 0) for them in columns),
        )
        table.add_row(
            "red side up", *(f"{np.mean([it.is_red for it in them]):.0%}" for them in columns)
        )
        table.add_row("ended", *map(_ends, columns))
        return table


def check_spreading(
    trial: Trial, states: Sequence[str], episodes: int, jobs: int, first_seed: int
) -> SpreadCheck:
    """Spreads handkerchiefs that lie in some states.

    Args:
        trial: the task and what is asked of the rule.
        states: names of `actors.envs.initial_states`.
        episodes: of each state.
        jobs: processes.
        first_seed: of the episodes, which are counted up from it.

    Raises:
        ValueError: there is no such task, option or state, or the task has another garment.
    """
    for state in states:
        check_initial_state(state)
    trial.check()
    end = first_seed + episodes
    chunks = [
        (state, list(range(first_seed + job, end, jobs))) for state in states for job in range(jobs)
    ]
    by_state: dict[str, list[SpreadEpisode]] = {state: [] for state in states}
    for (state, _), played in zip(chunks, mapped(partial(_play, trial), chunks, jobs), strict=True):
        by_state[state] += played
    return SpreadCheck(trial, by_state)


def draw_film_strip(path: Path, trial: Trial, state: str) -> None:
    """Writes the first episode of a state as a PNG: each picture with the pull that follows.

    Raises:
        ValueError: there is no such task, option or state, or the file is not to be a PNG.
    """
    if path.suffix != ".png":
        raise ValueError(f"film strip: expected a file that ends in .png; got {path}; name one")
    check_initial_state(state)
    trial.check()
    env = trial.made(render_mode="rgb_array")
    tiles: list[NDArray[np.uint8]] = []
    try:
        env.reset(seed=0, options={"initial_state": state})
        env.spread(
            trial.aim,
            trial.size_px,
            lambda pull, camera: tiles.append(_drawn(env, pull, camera)),
        )
        tiles.append(_drawn(env))
    finally:
        env.close()
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % STRIP_COLUMNS)
    rows = [np.hstack(tiles[at : at + STRIP_COLUMNS]) for at in range(0, len(tiles), STRIP_COLUMNS)]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.vstack(rows)).save(path, optimize=True)


Chunk = tuple[str, list[int]]
"""Episodes of which seeds begin in which state."""


def _play(trial: Trial, chunk: Chunk) -> list[SpreadEpisode]:
    state, seeds = chunk
    env = trial.made()
    try:
        return [_spread(env, trial, state, seed) for seed in seeds]
    finally:
        env.close()


def _spread(env: ClothTaskEnv, trial: Trial, state: str, seed: int) -> SpreadEpisode:
    env.reset(seed=seed, options={"initial_state": state})
    at_start = true_coverage(env.vertices_in_world(), env.garment)
    outcome = env.spread(trial.aim, trial.size_px)
    vertices = env.vertices_in_world()
    picture = draw_cloth(vertices, env.garment.mesh.faces, FAR_ABOVE)
    return SpreadEpisode(
        at_start,
        true_coverage(vertices, env.garment),
        float(np.hypot(*vertices[:, :2].mean(axis=0))),
        bool(2 * red_mask(picture).sum() > cloth_mask(picture).sum()),
        outcome.actions,
        outcome.end,
    )


def _drawn(
    env: ClothTaskEnv, pull: Pull | None = None, camera: Camera | None = None
) -> NDArray[np.uint8]:
    """The scene as a tile, with the pull that is to be made."""
    frame = env.render()
    assert frame is not None, "it was made with a render mode"
    drawn = cv2.resize(frame, (TILE_PX, TILE_PX), interpolation=cv2.INTER_AREA)
    if pull is not None and camera is not None:
        scale = TILE_PX / camera.size_px
        pick, drop = (
            tuple(round(coordinate * scale) for coordinate in place)
            for place in (pull.pick_px, pull.drop_px)
        )
        cv2.arrowedLine(drawn, pick, drop, (20, 20, 20), 4, cv2.LINE_AA, tipLength=0.15)
        cv2.arrowedLine(drawn, pick, drop, _ARROW, 2, cv2.LINE_AA, tipLength=0.15)
        cv2.putText(drawn, str(pull.kind), (5, 16), 0, 0.45, (20, 20, 20), 1, cv2.LINE_AA)
    drawn[:, -2:] = drawn[-2:] = 255
    return np.asarray(drawn, dtype=np.uint8)


def _rate(them: Sequence[SpreadEpisode]) -> float:
    return float(np.mean([it.is_back for it in them]))


def _actions(them: Sequence[SpreadEpisode]) -> str:
    actions = [it.actions for it in them]
    return f"{np.mean(actions):.1f}, {np.median(actions):g}, {np.quantile(actions, 0.95):g}"


def _quantiles(values: Sequence[float], digits: int = 2) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in np.quantile(values, (0.02, 0.5, 0.98)))


def _ends(them: Sequence[SpreadEpisode]) -> str:
    counted = Counter(it.end.value for it in them).most_common()
    return ", ".join(f"{end} {number}" for end, number in counted)
