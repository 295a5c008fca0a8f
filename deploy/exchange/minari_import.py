"""Imports a Minari dataset as demonstrations.

An episode that clothbus has exported is the same trajectory again, with its id, ticket and marks.
Any other becomes one of `imported`, with these conventions: success is that of the last step's
`infos` where they have it, and false otherwise; it is terminated or truncated as its last step
says, and truncated where that says neither or both; rewards are rounded to 32 bits.
"""

from __future__ import annotations

import hashlib
import io
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from broker_config.durable import new_folder
from broker_config.errors import MessageError, StorageError
from broker_config.messages import (
    DemonstrationsBegun,
    Demonstrator,
    ImportedDataset,
    TargetsMarked,
    Ticket,
    TrajectoryId,
)
from broker_config.preset import Preset, TaskPreset
from broker_config.structure import from_plain
from broker_config.version import VERSION
from deploy.demonstrations.folder import DemonstrationWriter
from deploy.exchange.facts import IMPORTED_ACTOR, TrajectoryFacts
from deploy.exchange.minari_format import (
    DATA_FILE,
    OWN_KEY,
    check_spaces,
    find_dataset,
    read_metadata,
    require_h5py,
)
from deploy.exchange.source import MarkedTrajectory

PICTURE_SECS = 0.1
"""Nobody noted when they were taken: viewers show ten a second, from the import on."""


class MinariDataset:
    """A dataset whose observations and actions are a task's; an episode is in memory at a time.

    Attributes:
        who: What it says of itself.
        episodes: How many it has.
    """

    def __init__(self, dataset: str, task: TaskPreset) -> None:
        """Reads what it says of itself.

        Args:
            dataset: Its folder, or its name in Minari's local storage.
            task: Which it must fit.

        Raises:
            PresetError: h5py is not installed.
            StorageError: There is none, it is of another task, or has no episode.
        """
        self._h5py, self._task = require_h5py(), task
        data = find_dataset(dataset)
        metadata = read_metadata(data)
        name = str(metadata.get("dataset_id") or dataset)
        check_spaces(metadata, task, name)
        self._path, self._may_be_jpeg = data / DATA_FILE, bool(metadata.get("jpeg_encoding", True))
        with self._open() as file:
            self.episodes = sum(key.startswith("episode_") for key in file)
        wanted = metadata.get("total_episodes")
        if self.episodes == 0 or self.episodes != wanted:
            raise StorageError(
                f"{name}: expected {wanted or 'at least one'} episodes; got {self.episodes}; "
                "fetch or export the dataset again"
            )
        algorithm = str(metadata.get("algorithm_name") or "")
        self.who = ImportedDataset(name, _digest(self._path), algorithm)

    def __iter__(self) -> Iterator[MarkedTrajectory]:
        """Its episodes in order.

        Raises:
            StorageError: One is damaged, or does not fit the task.
        """
        with self._open() as file:
            for number in range(self.episodes):
                subject = f"{self.who.id}: episode {number}"
                try:
                    yield self._read(file[f"episode_{number}"], number)
                except (KeyError, OSError, RuntimeError, TypeError, AttributeError) as error:
                    raise StorageError(
                        f"{subject}: expected an episode as Minari writes it; got {error}; fetch "
                        "or export the dataset again"
                    ) from error
                except MessageError as error:
                    raise StorageError(
                        f"{subject}: {error}; leave it out of the dataset"
                    ) from error

    def _open(self) -> Any:
        try:
            return self._h5py.File(self._path, "r")
        except OSError as error:
            raise StorageError(
                f"{self._path}: expected an HDF5 file; got {error}; fetch or export the dataset "
                "again"
            ) from error

    def _read(self, group: Any, number: int) -> MarkedTrajectory:
        arrays = _checked_arrays(group, self._task, may_be_jpeg=self._may_be_jpeg)
        facts = _own_facts(group)
        is_own = facts is not None
        if facts is None:
            facts = TrajectoryFacts(
                id=TrajectoryId(IMPORTED_ACTOR, self.who.digest[:16], number),
                ticket=Ticket(number, 0, 0, 0, 0, self._task.horizon, 0.0),
                success=_success(group, len(arrays.actions)),
                interrupted=False,
                ended_unix_secs=time.time(),
            )
        terminated, truncated = arrays.terminated, arrays.truncated
        if not is_own and terminated == truncated:
            terminated, truncated = False, True
        return facts.with_arrays(
            arrays.observations,
            arrays.actions,
            arrays.rewards,
            terminated=terminated,
            truncated=truncated,
        )


def import_minari(
    dataset: MinariDataset,
    preset: Preset,
    output: Path,
    on_trajectory: Callable[[], None] = lambda: None,
) -> int:
    """Writes demonstrations into a folder that is whole or not there.

    Args:
        dataset: What is imported.
        preset: Whose task was demonstrated.
        output: The folder, which is not there yet.
        on_trajectory: Called after each.

    Returns:
        How many steps they have.

    Raises:
        StorageError: The folder is there, the disk refuses, or an episode does not fit the task.
    """
    who = Demonstrator("imported", dataset=dataset.who)
    began_unix_secs, pictures, steps = time.time(), 0, 0
    ids = set[TrajectoryId]()
    with new_folder(output) as folder, DemonstrationWriter(folder) as demonstrations:
        demonstrations.begin(DemonstrationsBegun(who, 0, preset.to_json(), VERSION))
        for item in dataset:
            trajectory = item.trajectory
            if trajectory.id in ids:
                raise StorageError(
                    f"{dataset.who.id}: expected each trajectory once; got {trajectory.id} twice; "
                    "leave one out of the dataset"
                )
            ids.add(trajectory.id)
            seen = range(pictures, pictures := pictures + trajectory.steps + 1)
            demonstrations.add(trajectory, [began_unix_secs + PICTURE_SECS * it for it in seen])
            if item.targets:
                demonstrations.mark([TargetsMarked(trajectory.id, item.targets)])
            steps += trajectory.steps
            on_trajectory()
    return steps


@dataclass(frozen=True)
class _Arrays:
    observations: NDArray[np.uint8]
    actions: NDArray[np.int32]
    rewards: NDArray[np.float32]
    terminated: bool
    truncated: bool


def _checked_arrays(group: Any, task: TaskPreset, *, may_be_jpeg: bool) -> _Arrays:
    """An episode's arrays; their sizes are checked before they are read.

    Raises:
        MessageError: They do not fit the task, or each other.
    """
    steps = len(group["rewards"])
    if not 1 <= steps <= task.horizon:
        raise MessageError(
            f"expected 1 to {task.horizon} steps (the preset's horizon); got {steps}"
        )
    actions = _vector(group, "actions", steps, "iu")
    if int(actions.min()) < 0 or int(actions.max()) >= task.n_actions:
        raise MessageError(
            f"actions: expected 0 to {task.n_actions - 1}; got {actions.min()} to {actions.max()}"
        )
    with np.errstate(over="ignore"):  # what becomes infinite is refused with the trajectory
        rewards = _vector(group, "rewards", steps, "fiu").astype(np.float32)
    ends = []
    for key in ("terminations", "truncations"):
        said = _vector(group, key, steps, "b")
        if said[:-1].any():
            raise MessageError(f"{key}: expected none before the last step; got {said.tolist()}")
        ends.append(bool(said[-1]))
    shape = (steps + 1, *task.observation_shape)
    pictures = _pictures(group["observations"], shape, may_be_jpeg=may_be_jpeg)
    return _Arrays(pictures, actions.astype(np.int32), rewards, *ends)


def _vector(group: Any, key: str, steps: int, kinds: str) -> NDArray[Any]:
    stored = group[key]
    if stored.shape != (steps,) or stored.dtype.kind not in kinds:
        raise MessageError(
            f"{key}: expected one for each of {steps} steps, of numpy's kind {' or '.join(kinds)}; "
            f"got {stored.dtype} {list(stored.shape)}"
        )
    array: NDArray[Any] = stored[()]
    return array


def _pictures(stored: Any, shape: tuple[int, ...], *, may_be_jpeg: bool) -> NDArray[np.uint8]:
    """u8[T+1, H, W, C], from such an array, or from a JPEG for each picture."""
    if stored.shape == shape and stored.dtype == np.uint8:
        raw: NDArray[np.uint8] = stored[()]
        return raw
    if not may_be_jpeg or len(stored) != shape[0] or stored.ndim > 2:
        raise MessageError(
            f"observations: expected uint8 {list(shape)}; got {stored.dtype} {list(stored.shape)}"
        )
    pictures = np.empty(shape, np.uint8)
    for number, data in enumerate(stored):
        try:
            with Image.open(io.BytesIO(np.asarray(data, np.uint8).tobytes())) as image:
                picture = np.asarray(image)
        except (UnidentifiedImageError, Image.DecompressionBombError, ValueError) as error:
            raise MessageError(f"observation {number}: expected a JPEG; got {error}") from error
        if picture.shape != shape[1:] or picture.dtype != np.uint8:
            raise MessageError(
                f"observation {number}: expected uint8 {list(shape[1:])}; got {picture.dtype} "
                f"{list(picture.shape)}"
            )
        pictures[number] = picture
    return pictures


def _own_facts(group: Any) -> TrajectoryFacts | None:
    """What clothbus has written beside the arrays, if it is the one who did."""
    tree: dict[str, Any] = {}
    for key, value in group.attrs.items():
        *folders, name = key.split("/")
        place = tree
        for folder in folders:
            place = place.setdefault(folder, {})
        place[name] = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    if OWN_KEY not in tree:
        return None
    return from_plain(tree[OWN_KEY], TrajectoryFacts, OWN_KEY)


def _success(group: Any, steps: int) -> bool:
    """Of the last step; `infos` begin with those of `reset`, in most datasets."""
    stored = group["infos"].get("success") if "infos" in group else None
    if stored is None or stored.shape not in ((steps,), (steps + 1,)):
        return False
    return bool(stored[-1])


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
