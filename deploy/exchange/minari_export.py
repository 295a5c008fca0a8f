"""Exports episodes as a Minari dataset, from which nothing is missing.

What Minari has no place for (ids, tickets, success, who demonstrated, marked targets, the preset)
is in the metadata of the dataset and of its episodes, under `clothbus`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from broker_config.durable import new_folder
from broker_config.structure import to_plain
from broker_config.version import VERSION
from deploy.exchange.facts import demonstrated_by, facts_of, flags, reset_seed
from deploy.exchange.minari_format import (
    DATA_FILE,
    DATA_FOLDER,
    FORMAT_VERSION,
    METADATA_FILE,
    OWN_KEY,
    dataset_id,
    environment_spec,
    require_h5py,
    spaces_of,
)
from deploy.exchange.source import MarkedTrajectory, Source


def export_minari(
    source: Source, output: Path, on_trajectory: Callable[[], None] = lambda: None
) -> str:
    """Writes a folder that is whole or not there; a trajectory is in memory at a time.

    Args:
        source: What is exported; each of its trajectories is an episode of the dataset.
        output: The dataset's folder, which is not there yet.
        on_trajectory: Called after each.

    Returns:
        The dataset's name.

    Raises:
        PresetError: h5py is not installed, or the folder's name is none for a dataset.
        StorageError: The folder is there, the disk refuses, or the source is damaged.
    """
    h5py, name = require_h5py(), dataset_id(output)
    episodes = steps = 0
    with new_folder(output) as folder:
        data = folder / DATA_FOLDER
        data.mkdir()
        with h5py.File(data / DATA_FILE, "w", track_order=True) as file:
            for item in source:
                _write_episode(file.create_group(f"episode_{episodes}"), episodes, item)
                episodes += 1
                steps += item.trajectory.steps
                on_trajectory()
        size_mb = round((data / DATA_FILE).stat().st_size / 1e6, 1)
        counts = {"total_episodes": episodes, "total_steps": steps, "dataset_size": size_mb}
        metadata = {"dataset_id": name, **counts, **_about(source)}
        (data / METADATA_FILE).write_text(json.dumps(metadata))
    return name


def _write_episode(group: Any, number: int, item: MarkedTrajectory) -> None:
    it = item.trajectory
    attributes: dict[str, object] = {"id": number, "total_steps": it.steps}
    if (seed := reset_seed(it)) is not None:
        attributes["seed"] = seed
    for key, value in {**attributes, **_flat({OWN_KEY: to_plain(facts_of(item))})}.items():
        group.attrs[key] = value
    _write_array(group, "observations", it.observations, rows_of_a_chunk=1)
    for key, array in {
        "actions": it.actions,
        "rewards": it.rewards,
        "terminations": flags(it.terminated, it.steps),
        "truncations": flags(it.truncated, it.steps),
    }.items():
        _write_array(group, key, array, rows_of_a_chunk=it.steps)
    group.create_group("infos")  # without it, Minari's episodes cannot be printed


def _write_array(group: Any, key: str, array: np.ndarray[Any, Any], rows_of_a_chunk: int) -> None:
    group.create_dataset(
        key,
        data=array,
        chunks=(rows_of_a_chunk, *array.shape[1:]),
        maxshape=(None, *array.shape[1:]),  # Minari may add steps
        compression="gzip",
    )


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, object]:
    """As Minari names what is nested: `a/b`; what is None or empty is left out."""
    flat: dict[str, object] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key}/"))
        elif value is not None and value != []:
            flat[f"{prefix}{key}"] = value
    return flat


def _about(source: Source) -> dict[str, object]:
    preset = source.preset
    acted = demonstrated_by(source)
    return {
        "data_format": "hdf5",
        "jpeg_encoding": False,
        **spaces_of(preset.task),
        "env_spec": environment_spec(preset.task),
        "minari_version": FORMAT_VERSION,
        "algorithm_name": acted,
        "description": f"{preset.task.environment} ({preset.name}), acted by {acted}",
        "requirements": [f"clothbus=={VERSION}"],
        OWN_KEY: {
            "source": source.path.resolve().name,
            "preset": json.loads(preset.to_json()),
            "demonstrations": to_plain(source.origin),
            "clothbus_version": VERSION,
        },
    }
