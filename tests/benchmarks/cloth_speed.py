"""Random picks and drops a second of processor time: both engines, all garments.

    python -m tests.benchmarks.cloth_speed --actions 100 --rounds 3

Beside them PyBullet's cloth with the numbers of deformable-ravens makes the same picks and drops on
a handkerchief of the same size: 10 x 10 vertices, 0.5 kg, spring 40, damping 0.1, friction 1, a
margin of a fifth of an edge, 480 steps a second, as in `defs_cloth.py` and `environment.py` of
github.com/DanielTakeshi/deformable-ravens. What is timed is the engine alone; a picture costs less
than 1 ms.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from actors.cloth.engine import ClothEngine
from actors.cloth.garments import GARMENT_KINDS, make_garment, usual_spacing_m
from actors.cloth.gestures import pick_and_drop
from actors.cloth.grasps import grasped_vertices
from actors.cloth.guard import guard
from actors.cloth.meshes import ClothMesh, rectangular_sheet
from actors.cloth.pybullet_engine import PyBulletEngine
from actors.cloth.pybullet_settings import PyBulletSettings
from actors.cloth.xpbd_engine import XpbdEngine
from tests.benchmarks.measuring import RESULTS, keep_result

ACTIONS_OF_AN_EPISODE = 6
DROP_HALF_WIDTH_M = 0.12
RAVENS_VERTICES = 10
RAVENS_EDGE_M = 0.3 / (RAVENS_VERTICES - 1)
RAVENS = PyBulletSettings(
    time_step_secs=1 / 480,
    mass_kg=0.5,
    elastic_stiffness=40.0,
    damping_stiffness=0.1,
    bending_stiffness=0.1,  # PyBullet's default: they give none
    friction=1.0,
    collision_margin_m=RAVENS_EDGE_M / 5,
)


@dataclass(frozen=True)
class Candidate:
    """An engine and the cloth that it moves."""

    name: str
    engine: Callable[[], ClothEngine]
    mesh: ClothMesh


def candidates() -> list[Candidate]:
    """All that are compared."""
    found = []
    for kind in GARMENT_KINDS:
        for name, engine in (("xpbd", XpbdEngine), ("pybullet", PyBulletEngine)):
            mesh = make_garment(kind, spacing_m=usual_spacing_m(kind, name)).mesh
            found.append(Candidate(f"{kind}, {name}", engine, mesh))
    ravens = rectangular_sheet(RAVENS_VERTICES, 0.3)
    name = "handkerchief, pybullet as deformable-ravens has it"
    return [*found, Candidate(name, lambda: PyBulletEngine(RAVENS), ravens)]


def actions_per_cpu_sec(candidate: Candidate, n_actions: int, seed: int) -> tuple[float, int]:
    """Rate, and how many episodes a guard ended."""
    engine, random = candidate.engine(), np.random.default_rng(seed)
    engine.reset(candidate.mesh)
    _pick_and_drop(engine, random)  # compiles
    used_secs, broken = 0.0, 0
    for action in range(n_actions):
        if action % ACTIONS_OF_AN_EPISODE == 0 or guard(engine.mesh, engine.vertices_in_world()):
            engine.reset(candidate.mesh)
        used_secs += _pick_and_drop(engine, random)
        broken += guard(engine.mesh, engine.vertices_in_world()) is not None
    engine.close()
    return n_actions / used_secs, broken


def _pick_and_drop(engine: ClothEngine, random: np.random.Generator) -> float:
    begin = time.process_time()
    vertices = engine.vertices_in_world()
    x_m, y_m, _ = vertices[random.integers(len(vertices))].tolist()
    drop_x_m, drop_y_m = random.uniform(-DROP_HALF_WIDTH_M, DROP_HALF_WIDTH_M, 2).tolist()
    grasped = grasped_vertices(vertices, (x_m, y_m))
    engine.perform(pick_and_drop(vertices, grasped, (drop_x_m, drop_y_m)))
    return time.process_time() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--actions", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=RESULTS)
    given = parser.parse_args()
    rates: dict[str, list[float]] = {}
    broken: dict[str, int] = {}
    everyone = candidates()
    for number in range(given.rounds):
        for it in everyone:
            # PyBullet is far slower; a quarter of the actions says as much.
            n_actions = given.actions if "xpbd" in it.name else max(1, given.actions // 4)
            rate, stopped = actions_per_cpu_sec(it, n_actions, seed=number)
            rates.setdefault(it.name, []).append(round(rate, 2))
            broken[it.name] = broken.get(it.name, 0) + stopped
            print(f"round {number}: {it.name}: {rate:.1f} actions a second", flush=True)
    vertices = {it.name: len(it.mesh.vertices_m) for it in everyone}
    keep_result(
        given.out,
        "cloth_speed",
        {"actions": given.actions, "rates": rates, "vertices": vertices, "guarded": broken},
    )


if __name__ == "__main__":
    main()
