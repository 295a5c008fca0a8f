"""Minari's dataset format, as far as pictures and numbered actions need it.

::

    DATASET/data/metadata.json     spaces, environment, how many episodes and steps, its name
    DATASET/data/main_data.hdf5    a group `episode_K` for each episode: observations [T+1, ...],
                                   actions, rewards, terminations and truncations [T], infos;
                                   attributes id, total_steps, seed, and whatever else

It is written and read with h5py, without Minari: Minari's own writer compresses nothing, and needs
a command line and a validation library that clothbus has no use for. Tests read what is written
with Minari.
"""

from __future__ import annotations

import importlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from gymnasium.envs.registration import EnvSpec

from broker_config.errors import PresetError, StorageError
from broker_config.preset import TaskPreset

DATA_FOLDER: Final = "data"
DATA_FILE: Final = "main_data.hdf5"
METADATA_FILE: Final = "metadata.json"
OWN_KEY: Final = "clothbus"
"""Under which the metadata of the dataset and of its episodes say what only clothbus knows."""

FORMAT_VERSION: Final = "0.5.4"
"""The first version of Minari that knows pictures that are no JPEGs; older ones refuse it."""

_ID = re.compile(r"(?:[-_\w][-_\w/]*[-_\w]/)?[-_\w]+-v\d+")


def require_h5py() -> Any:
    """The module.

    Raises:
        PresetError: It is not installed.
    """
    try:
        return importlib.import_module("h5py")
    except ImportError as error:
        raise PresetError(
            "minari: expected the package h5py; it is not installed; pip install clothbus[hdf5]"
        ) from error


def local_storage() -> Path:
    """The folder in which Minari finds datasets by their names."""
    given = os.environ.get("MINARI_DATASETS_PATH")
    return Path(given) if given else Path.home() / ".minari" / "datasets"


def dataset_id(folder: Path) -> str:
    """The name of a dataset that is written into a folder.

    In Minari's local storage it is the path there, by which `minari.load_dataset` finds it; else
    `clothbus/NAME`, with `-v0` where the folder's name has no version.

    Raises:
        PresetError: It is no name to Minari.
    """
    place, storage = folder.resolve(), local_storage().resolve()
    if place.is_relative_to(storage):
        name = place.relative_to(storage).as_posix()
    else:
        name = f"clothbus/{place.name}"
        name += "" if re.search(r"-v\d+$", name) else "-v0"
    if not _ID.fullmatch(name):
        raise PresetError(
            f"{folder}: expected a folder whose name is one of a Minari dataset, such as "
            f"flipping-v0; got {name}; use letters, digits, '-', '_', and a version at the end"
        )
    return name


def find_dataset(dataset: str) -> Path:
    """The folder with a dataset's two files.

    Args:
        dataset: A dataset's folder, or its name in Minari's local storage.

    Raises:
        StorageError: There is none.
    """
    for folder in (Path(dataset), local_storage() / dataset):
        for data in (folder / DATA_FOLDER, folder):
            if (data / METADATA_FILE).is_file():
                return data
    raise StorageError(
        f"{dataset}: expected a Minari dataset's folder, or its name in {local_storage()}; got "
        "neither; `minari download` fetches one"
    )


def spaces_of(task: TaskPreset) -> dict[str, str]:
    """The task's observations and actions, as JSON."""
    shape = list(task.observation_shape)
    bounds = {"low": _filled(shape, 0), "high": _filled(shape, 255)}
    observations = {"type": "Box", "dtype": "uint8", "shape": shape, **bounds}
    actions = {"type": "Discrete", "dtype": "int64", "start": 0, "n": task.n_actions}
    return {
        "observation_space": json.dumps(observations),
        "action_space": json.dumps(actions),
    }


def _filled(shape: list[int], value: int) -> object:
    filled: object = value
    for size in reversed(shape):
        filled = [filled] * size
    return filled


def environment_spec(task: TaskPreset) -> str:
    """What `gymnasium.make` takes to make the task's environment, as JSON."""
    return EnvSpec(
        id=task.environment,
        entry_point="actors.envs:make_env",
        max_episode_steps=task.horizon,
        order_enforce=False,
        kwargs={"env_id": task.environment, "horizon": task.horizon, **task.options},
    ).to_json()


def read_metadata(data: Path) -> dict[str, Any]:
    """What a dataset says of itself.

    Args:
        data: The folder with its two files.

    Raises:
        StorageError: It cannot be read, or its episodes are in another format.
    """
    path = data / METADATA_FILE
    try:
        metadata = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise StorageError(
            f"{path}: expected a dataset's metadata as JSON; got {error}; export it again"
        ) from error
    got = metadata.get("data_format", "hdf5") if isinstance(metadata, dict) else metadata
    if got != "hdf5":
        raise StorageError(
            f"{path}: expected episodes as hdf5; got {got}; write the dataset anew with Minari's "
            "data_format='hdf5'"
        )
    return dict(metadata)


def check_spaces(metadata: Mapping[str, Any], task: TaskPreset, name: str) -> None:
    """Refuses a dataset whose observations or actions are not the task's.

    Raises:
        StorageError: They differ, or the dataset does not say.
    """
    picture, actions = (_space(metadata, f"{each}_space") for each in ("observation", "action"))
    got = [picture.get(key) for key in ("type", "dtype", "shape")]
    if got != ["Box", "uint8", list(task.observation_shape)]:
        raise StorageError(
            f"{name}: expected observations uint8 {list(task.observation_shape)}, as "
            f"{task.environment} has; got {' '.join(map(str, got))}; name the preset of its task"
        )
    got = [actions.get(key) for key in ("type", "n")]
    if got != ["Discrete", task.n_actions] or actions.get("start", 0) != 0:
        raise StorageError(
            f"{name}: expected actions 0 to {task.n_actions - 1}, as {task.environment} has; got "
            f"{actions}; name the preset of its task"
        )


def _space(metadata: Mapping[str, Any], key: str) -> dict[str, Any]:
    try:
        space = json.loads(metadata[key])
    except (KeyError, TypeError, ValueError):
        space = None
    return space if isinstance(space, dict) else {}
