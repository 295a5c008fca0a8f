"""Pictures of every cloth task, for people to look at.

    python -m deploy.tasks.gallery docs/gallery

Writes `experts.png` (what the scripted expert does), `states.png` (the initial states), `looks.png`
(randomised for sim-to-real) and `robot.png` (the arms at work).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from actors.demonstrate.acting import scripted_demonstrator
from actors.envs import ENV_IDS, ClothTaskEnv, make_env
from actors.envs.initial_states import INITIAL_STATES
from deploy.tasks.watch import played

Picture = NDArray[np.uint8]
Row = tuple[str, list[tuple[str, Picture]]]
"""A name, and pictures with their captions."""

SIZE_PX: Final = 168
MOST_ACTIONS: Final = 4
COLUMNS: Final = 2 * MOST_ACTIONS
CLOTH_IDS: Final = tuple(name for name in ENV_IDS if "Reaching" not in name)
ONE_FOR_EACH_GARMENT: Final = ("HandkerchiefFlip36", "TShirtFold", "ShirtFold", "TrousersFold")
ROBOT_DOES: Final = ("HandkerchiefFlip36", "ShirtFold")


def experts() -> list[Row]:
    """What is to be done and what came of it, action by action."""
    rows = []
    for env_id in CLOTH_IDS:
        env = _made(env_id, **({"horizon": MOST_ACTIONS} if "Flip" in env_id else {}))
        frames = played(env, scripted_demonstrator(env, env.n_actions, 0.0), seed=0).frames[1:]
        named = [
            (f"{'action' if number % 2 == 0 else 'after'} {number // 2 + 1}", frame)
            for number, frame in enumerate(frames[:COLUMNS])
        ]
        rows.append((_short(env_id), named))
        env.close()
    return rows


def states() -> list[Row]:
    """Each garment in each initial state."""
    return [
        (name, [(state, _at_start(name, initial_state=state)) for state in INITIAL_STATES])
        for name in ONE_FOR_EACH_GARMENT
    ]


def looks() -> list[Row]:
    """Each garment as sim2real draws it."""
    return [
        (
            name,
            [
                (f"seed {seed}", _at_start(name, seed=seed, randomisation="sim2real"))
                for seed in range(COLUMNS)
            ],
        )
        for name in ONE_FOR_EACH_GARMENT
    ]


def robot() -> list[Row]:
    """One action of the arms, from reaching out to drawing back."""
    rows = []
    for name in ROBOT_DOES:
        env = _made(f"clothbus/{name}-v0", horizon=1, robot=True)
        frames = played(env, scripted_demonstrator(env, env.n_actions, 0.0), seed=0).frames
        chosen = np.linspace(len(frames) // 4, len(frames) - 1, COLUMNS).round().astype(int)
        rows.append((name, [("", frames[index]) for index in chosen]))
        env.close()
    return rows


def _made(env_id: str, **given: Any) -> ClothTaskEnv:
    env = make_env(env_id, render_mode="rgb_array", render_px=SIZE_PX, **given).unwrapped
    assert isinstance(env, ClothTaskEnv)
    return env


def _at_start(name: str, seed: int = 0, **given: Any) -> Picture:
    env = _made(f"clothbus/{name}-v0", **given)
    env.reset(seed=seed)
    picture = env.render()
    assert picture is not None, "it was made with a render mode"
    env.close()
    return picture


def _short(env_id: str) -> str:
    return env_id.removeprefix("clothbus/").removesuffix("-v0")


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Writes rows of pictures as a PNG."""
    columns = max(len(pictures) for _, pictures in rows)
    figure, axes = plt.subplots(
        len(rows), columns, figsize=(1.3 * columns, 1.45 * len(rows)), layout="constrained",
        squeeze=False,
    )  # fmt: skip
    for axis in axes.flat:
        axis.set_axis_off()
    for (name, pictures), cells in zip(rows, axes, strict=True):
        for (caption, picture), axis in zip(pictures, cells, strict=False):
            axis.imshow(picture)
            axis.set_title(caption, fontsize=6, pad=1)
        cells[0].text(-0.06, 0.5, name, rotation=90, va="center", ha="right", fontsize=6,
                      transform=cells[0].transAxes)  # fmt: skip
    figure.savefig(path, dpi=110)
    plt.close(figure)


PICTURES: Final = {"experts": experts, "states": states, "looks": looks, "robot": robot}


def main() -> None:
    """Draws all pictures, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", choices=PICTURES, default=list(PICTURES))
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    for name in arguments.only:
        draw(arguments.folder / f"{name}.png", PICTURES[name]())


if __name__ == "__main__":
    main()
