"""Random actions of every garment's task, and how many of them broke the cloth.

    python -m tests.benchmarks.cloth_blow_ups --actions 10000
    python -m tests.benchmarks.cloth_blow_ups --engine pybullet --tasks HandkerchiefFlip36 \
        --actions 300

Goes on where it was stopped: each episode's counts are a line of `build/bench/blow_ups.jsonl`.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path

import numpy as np

from actors.envs import ClothTaskEnv, make_env
from tests.benchmarks.measuring import RESULTS, keep_result

TASKS = ("HandkerchiefFlip36", "TShirtFold", "ShirtFold", "TrousersFold")
"""One for each garment."""
EPISODES = Path("build/bench/blow_ups.jsonl")


def play(env: ClothTaskEnv, seed: int) -> tuple[int, str | None]:
    """A random episode: how many actions, and why the guard ended it."""
    random = np.random.default_rng(seed)
    env.reset(seed=seed)
    n_actions, truncated, reason = 0, False, None
    while not truncated:
        *_, truncated, info = env.step(int(random.integers(env.n_actions)))
        n_actions, reason = n_actions + 1, info["guard"]
        vertices = env.vertices_in_world()
        assert np.isfinite(vertices).all(), "the guard let through what is no number"
    return n_actions, reason


def count(task: str, engine: str, least_actions: int, episodes: Path) -> Counter[str]:
    """Plays what is missing; actions, episodes and guarded steps by reason."""
    counts: Counter[str] = Counter()
    if episodes.exists():
        for text in episodes.read_text().splitlines():
            line = json.loads(text)
            if (line["task"], line["engine"]) == (task, engine):
                counts.update(line["counts"])
    env = make_env(f"clothbus/{task}-v0", engine=engine).unwrapped
    assert isinstance(env, ClothTaskEnv)
    episodes.parent.mkdir(parents=True, exist_ok=True)
    with episodes.open("a") as file:
        while counts["actions"] < least_actions:
            n_actions, reason = play(env, seed=counts["episodes"])
            found = Counter({"actions": n_actions, "episodes": 1})
            if reason is not None:
                found[reason] += 1
            counts += found
            file.write(json.dumps({"task": task, "engine": engine, "counts": found}) + "\n")
            file.flush()
    env.close()
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--actions", type=int, default=10_000)
    parser.add_argument("--engine", default="xpbd")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    parser.add_argument("--episodes", type=Path, default=EPISODES)
    parser.add_argument("--out", type=Path, default=RESULTS)
    given = parser.parse_args()
    for task in given.tasks:
        counts = count(task, given.engine, given.actions, given.episodes)
        guarded = {k: n for k, n in counts.items() if k not in {"actions", "episodes"}}
        result = {"task": task, "engine": given.engine, "actions": counts["actions"]}
        keep_result(given.out, "cloth_blow_ups", {**result, "guarded": guarded})


if __name__ == "__main__":
    main()
