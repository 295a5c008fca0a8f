"""The same picks and drops on both engines, and how alike the cloth then lies.

    python -m tests.benchmarks.engine_comparison --episodes 20 --picture docs/engines.png

Both move the same coarse mesh, each from where it lies there itself. As crumpling is chaotic, XPBD
is also compared with XPBD whose cloth began 1 mm further: no two engines can agree better.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.engine import ClothEngine
from actors.cloth.garments import GARMENT_KINDS, Garment, make_garment, usual_spacing_m
from actors.cloth.gestures import pick_and_drop
from actors.cloth.grasps import grasped_vertices
from actors.cloth.masks import cloth_mask
from actors.cloth.measures import iou
from actors.cloth.pybullet_process import PyBulletProcessEngine
from actors.cloth.rasteriser import HANDKERCHIEF_COLOURS, draw_cloth
from actors.cloth.xpbd_engine import XpbdEngine
from tests.benchmarks.measuring import RESULTS, keep_result

EYE = Camera(view_half_width_m=0.35)
SHOWN = Camera(size_px=168, view_half_width_m=0.35)
ACTIONS = 3
SHIFT_M = 0.001
SHOWN_EPISODES = 2
Points = NDArray[np.float64]


@dataclass(frozen=True)
class Pick:
    """One action: a vertex of the mesh and where it is dropped."""

    vertex: int
    drop_xy_m: tuple[float, float]


def drawn_picks(garment: Garment, seed: int) -> list[Pick]:
    """What an episode does."""
    random = np.random.default_rng(seed)
    return [
        Pick(
            int(random.integers(len(garment.mesh.vertices_m))),
            tuple(random.uniform(-0.12, 0.12, 2).tolist()),
        )
        for _ in range(ACTIONS)
    ]


def played(
    engine: ClothEngine, garment: Garment, picks: list[Pick], shift_m: float
) -> list[Points]:
    """Where the vertices are before the first and after each action."""
    engine.reset(garment.mesh, garment.mesh.vertices_m + np.array([shift_m, 0.0, 0.0]))
    states = [engine.vertices_in_world()]
    for pick in picks:
        vertices = states[-1]
        x_m, y_m, _ = vertices[pick.vertex].tolist()
        grasped = grasped_vertices(vertices, (x_m, y_m))
        engine.perform(pick_and_drop(vertices, grasped, pick.drop_xy_m))
        states.append(engine.vertices_in_world())
    return states


def differences(garment: Garment, one: Points, other: Points) -> dict[str, float]:
    """How unlike two states are."""
    faces = garment.mesh.faces
    masks = [cloth_mask(draw_cloth(it, faces, EYE, HANDKERCHIEF_COLOURS)) for it in (one, other)]
    flat = cloth_mask(draw_cloth(garment.mesh.vertices_m, faces, EYE, HANDKERCHIEF_COLOURS)).sum()
    return {
        "coverage": abs(float(masks[0].sum()) - float(masks[1].sum())) / float(flat),
        "iou": iou(*masks),
        "distance_mm": 1e3 * float(np.linalg.norm(one - other, axis=1).mean()),
    }


def row(garment: Garment, one: list[Points], other: list[Points]) -> NDArray[np.uint8]:
    """Both engines' pictures, action by action."""
    faces = garment.mesh.faces
    pictures = [
        np.concatenate([draw_cloth(it, faces, SHOWN) for it in pair], axis=0)
        for pair in zip(one, other, strict=True)
    ]
    return np.concatenate(pictures, axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--out", type=Path, default=RESULTS)
    given = parser.parse_args()
    measured: dict[str, dict[str, list[dict[str, float]]]] = {}
    rows = []
    for kind in GARMENT_KINDS:
        garment = make_garment(kind, spacing_m=usual_spacing_m(kind, "pybullet"))
        found: dict[str, list[list[dict[str, float]]]] = {"pybullet": [], "xpbd, 1 mm off": []}
        for seed in range(given.episodes):
            picks = drawn_picks(garment, seed)
            reference = PyBulletProcessEngine()
            ours, theirs = (played(it, garment, picks, 0.0) for it in (XpbdEngine(), reference))
            reference.close()
            shifted = played(XpbdEngine(), garment, picks, SHIFT_M)
            for name, states in (("pybullet", theirs), ("xpbd, 1 mm off", shifted)):
                found[name].append(
                    [differences(garment, *it) for it in zip(ours, states, strict=True)]
                )
            if seed < SHOWN_EPISODES:
                rows.append(row(garment, ours, theirs))
            print(f"{kind}, episode {seed + 1} of {given.episodes}", flush=True)
        measured[kind] = {name: _medians(them) for name, them in found.items()}
    if given.picture is not None:
        sheet = np.concatenate(
            [np.concatenate(rows[i : i + 2], axis=1) for i in range(0, len(rows), 2)], axis=0
        )
        cv2.imwrite(str(given.picture), sheet[:, :, ::-1])
    keep_result(given.out, "engine_comparison", {"episodes": given.episodes, "medians": measured})


def _medians(episodes: list[list[dict[str, float]]]) -> list[dict[str, float]]:
    """Over episodes, for each number of actions from 1 on."""
    return [
        {
            name: round(float(np.median([episode[action][name] for episode in episodes])), 3)
            for name in episodes[0][action]
        }
        for action in range(1, ACTIONS + 1)
    ]


if __name__ == "__main__":
    main()
