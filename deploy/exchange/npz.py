"""Exports episodes as NPZ: a compressed file for each trajectory, and two of JSON.

::

    episode_000000.npz   observations u8[T+1, H, W, C], actions i32[T], rewards f32[T],
                         terminations bool[T], truncations bool[T]
    episode_000001.npz   ...
    episodes.jsonl       a line for each: its file, steps, return, the seed of `reset`, its ticket
                         (with policy version and epsilon), its id, success, marked targets
    dataset.json         the preset, who acted, how many there are

An episode whose actor died in between has several trajectories, with one ticket index.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from broker_config.durable import new_folder
from broker_config.structure import to_plain
from broker_config.version import VERSION
from deploy.exchange.facts import demonstrated_by, facts_of, flags, reset_seed
from deploy.exchange.source import MarkedTrajectory, Source

EPISODES_FILE = "episodes.jsonl"
DATASET_FILE = "dataset.json"


def export_npz(
    source: Source, output: Path, on_trajectory: Callable[[], None] = lambda: None
) -> None:
    """Writes a folder that is whole or not there; a trajectory is in memory at a time.

    Args:
        source: What is exported.
        output: The folder, which is not there yet.
        on_trajectory: Called after each.

    Raises:
        StorageError: The folder is there, the disk refuses, or the source is damaged.
    """
    steps = 0
    with new_folder(output) as folder:
        with (folder / EPISODES_FILE).open("w") as lines:
            for number, item in enumerate(source):
                file = f"episode_{number:06}.npz"
                _write_arrays(folder / file, item)
                lines.write(json.dumps({"file": file, **_line_of(item)}) + "\n")
                steps += item.trajectory.steps
                on_trajectory()
        about = _about(source, steps)
        (folder / DATASET_FILE).write_text(json.dumps(about, indent=2) + "\n")


def _write_arrays(path: Path, item: MarkedTrajectory) -> None:
    it = item.trajectory
    np.savez_compressed(
        path,
        observations=it.observations,
        actions=it.actions,
        rewards=it.rewards,
        terminations=flags(it.terminated, it.steps),
        truncations=flags(it.truncated, it.steps),
    )


def _line_of(item: MarkedTrajectory) -> dict[str, object]:
    it = item.trajectory
    plain = to_plain(facts_of(item))
    assert isinstance(plain, dict)
    return {"steps": it.steps, "return": it.return_, "reset_seed": reset_seed(it), **plain}


def _about(source: Source, steps: int) -> dict[str, object]:
    return {
        "source": source.path.resolve().name,
        "acted": demonstrated_by(source),
        "trajectories": source.trajectories,
        "steps": steps,
        "preset": json.loads(source.preset.to_json()),
        "demonstrations": to_plain(source.origin),
        "clothbus_version": VERSION,
    }
