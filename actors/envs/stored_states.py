"""Initial states in a file: cloth that lies the same, whatever a later version makes of a seed.

A file is an npz of named arrays; `clothbus states` writes one. These come with clothbus and are
chosen by their name:

| name | garment | states, 10 of each | for |
|---|---|---|---|
| `handkerchief` | 0.3 m, 400 vertices | `flat`, `random`, `folded_over` | table 4.3 |
| `shirt` | 529 vertices | `flat`, `rotated`, `shifted`, `creased` | table 4.5 |
| `trousers` | 485 vertices | the same | table 4.5 |

**assumed**: which states the tables had: they show pictures, and name only the random one.
"""

import hashlib
import io
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from actors.cloth.garments import Garment
from actors.cloth.guard import guard
from actors.cloth.meshes import ClothMesh
from actors.envs.initial_states import INITIAL_STATES
from broker_config.durable import write_durably

SCHEMA_VERSION: Final = 1
SUFFIX: Final = ".npz"
PACKAGED: Final = Path(__file__).parent / "states"

GRID_M: Final = 2.0**-14
"""Vertices are stored to 0.06 mm, which the cloth cannot tell, in half the bytes."""

_DAMAGE = (OSError, EOFError, ValueError, NotImplementedError, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True, eq=False)
class StoredStart:
    """One of the states of a file."""

    initial_state: str
    stored_index: int
    """Among those of that name, from 0."""
    vertices_m: NDArray[np.float64]
    """f64[V, 3], in the world."""

    @property
    def reset_options(self) -> dict[str, Any]:
        """What `reset(options=...)` begins there with; `info` holds the same."""
        return {"initial_state": self.initial_state, "stored_index": self.stored_index}


@dataclass(frozen=True, eq=False)
class StoredStates:
    """Initial states of one garment."""

    task: str
    """Id of the environment in which they were made."""

    garment: str
    """Its name."""

    mesh_digest: str
    """See `mesh_digest`."""

    names: tuple[str, ...]
    """Of each state, S of them."""

    seeds: NDArray[np.int64]
    """i64[S], from which each was made."""

    vertices_m: NDArray[np.float32]
    """f32[S, V, 3], in the world."""

    def __post_init__(self) -> None:
        """Check the arrays against each other.

        Raises:
            ValueError: there is no state, a name is unknown, or an array is out of the rule.
        """
        if unknown := sorted(set(self.names) - set(INITIAL_STATES)):
            raise ValueError(
                f"names: expected some of {', '.join(INITIAL_STATES)}; got {', '.join(unknown)}"
            )
        n_states = len(self.names)
        _check_array("seeds", self.seeds, np.dtype(np.int64), (n_states,))
        _check_array("vertices_m", self.vertices_m, np.dtype(np.float32), (n_states, None, 3))
        if not np.isfinite(self.vertices_m).all():
            raise ValueError("vertices_m: expected finite numbers; got others")

    @property
    def digest(self) -> str:
        """SHA-256 of the garment and of where its vertices are: of what an episode begins with."""
        digest = hashlib.sha256(f"{self.mesh_digest} {' '.join(self.names)} ".encode())
        digest.update(np.ascontiguousarray(self.vertices_m).tobytes())
        return digest.hexdigest()

    def start(
        self, name: str, index: int | None = None, random: np.random.Generator | None = None
    ) -> StoredStart:
        """A state by its name.

        Args:
            name: of the state.
            index: among those of that name.
            random: draws the index where none is given.

        Raises:
            ValueError: there is no such state.
        """
        those = [number for number, its_name in enumerate(self.names) if its_name == name]
        if not those:
            raise ValueError(
                f"initial_state: expected one of {', '.join(dict.fromkeys(self.names))}, which are "
                f"stored; got {name!r}; name one of them, or store it with `clothbus states`"
            )
        if index is None:
            assert random is not None, "whoever names no index lets chance choose"
            index = int(random.integers(len(those)))
        if not isinstance(index, int) or not 0 <= index < len(those):
            raise ValueError(
                f"stored_index: expected an integer from 0 to {len(those) - 1}; got {index!r}; "
                f"there are {len(those)} states {name}"
            )
        return StoredStart(name, index, self.vertices_m[those[index]].astype(np.float64))

    def starts(self) -> list[StoredStart]:
        """All states, in the file's order."""
        met = dict.fromkeys(self.names, 0)
        starts = []
        for name in self.names:
            starts.append(self.start(name, met[name]))
            met[name] += 1
        return starts

    def check_garment(self, garment: Garment) -> None:
        """Check that the states are of this garment, and each of them a sound cloth.

        Raises:
            ValueError: it is another garment, or a state is not sound.
        """
        if mesh_digest(garment.mesh) != self.mesh_digest:
            raise ValueError(
                f"expected states of this garment, {_described(garment.name, garment.mesh)}; got "
                f"some of {self.garment}, {self.vertices_m.shape[1]} vertices; give the task the "
                f"options of {self.task} that they were made with, or make them for this garment "
                "with `clothbus states`"
            )
        for start in self.starts():
            if reason := guard(garment.mesh, start.vertices_m):
                raise ValueError(
                    f"state {start.initial_state} {start.stored_index}: expected a sound cloth; "
                    f"got {reason}; make the file anew"
                )


def mesh_digest(mesh: ClothMesh) -> str:
    """SHA-256 of a garment at rest, to the micrometre: the last bits differ between processors."""
    rest_um = np.rint(mesh.vertices_m * 1e6).astype(np.int64)
    return hashlib.sha256(rest_um.tobytes() + mesh.faces.astype(np.int64).tobytes()).hexdigest()


def on_grid(vertices_m: NDArray[np.float64]) -> NDArray[np.float32]:
    """Vertices as they are stored, f32 of the same shape."""
    return (np.rint(vertices_m / GRID_M) * GRID_M).astype(np.float32)


def packaged_states() -> list[str]:
    """The names of the files that come with clothbus."""
    return sorted(path.stem for path in PACKAGED.glob(f"*{SUFFIX}"))


def stored_states_of(source: str, garment: Garment) -> StoredStates:
    """The states of a file, for a garment.

    Args:
        source: a file that ends in .npz, or one of `packaged_states`.
        garment: what they must be of.

    Raises:
        ValueError: see `read_stored_states` and `StoredStates.check_garment`.
    """
    states = read_stored_states(source)
    try:
        states.check_garment(garment)
    except ValueError as error:
        raise ValueError(f"stored_states {source}: {error}") from error
    return states


def read_stored_states(source: str) -> StoredStates:
    """The states of a file.

    Args:
        source: a file that ends in .npz, or one of `packaged_states`.

    Raises:
        ValueError: there is no such file, it is damaged or something else, or of an unknown
            version.
    """
    path = Path(source)
    if path.suffix != SUFFIX:
        path = PACKAGED / f"{source}{SUFFIX}"
        if not path.exists():
            raise ValueError(
                f"stored_states: expected a file that ends in {SUFFIX}, or one of "
                f"{', '.join(packaged_states())}; got {source!r}; `clothbus states` makes files"
            )
    try:
        return _parsed(_arrays(path))
    except _DAMAGE as error:
        raise ValueError(
            f"stored_states {path}: expected a whole file of states; got {error}; make it anew "
            "with `clothbus states`"
        ) from error


def write_stored_states(path: Path, states: StoredStates) -> None:
    """Write a file, whole or not at all; equal states give equal bytes.

    Raises:
        ValueError: the file's name does not end in .npz.
        OSError: the disk refuses; what was there before is as it was.
    """
    if path.suffix != SUFFIX:
        raise ValueError(f"output: expected a file that ends in {SUFFIX}; got {path}; rename it")
    file = io.BytesIO()
    np.savez_compressed(
        file,
        schema_version=np.int64(SCHEMA_VERSION),
        task=np.str_(states.task),
        garment=np.str_(states.garment),
        mesh_digest=np.str_(states.mesh_digest),
        names=np.array(states.names),
        seeds=states.seeds,
        vertices_m=np.ascontiguousarray(states.vertices_m.transpose(0, 2, 1)),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_durably(path, file.getvalue())


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Everything that a file holds; its checksums are right."""
    with zipfile.ZipFile(path) as archive:
        if damaged := archive.testzip():
            raise ValueError(f"damage in {damaged}")
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def _parsed(arrays: Mapping[str, NDArray[Any]]) -> StoredStates:
    version = arrays.get("schema_version")
    if version is None or version.tolist() != SCHEMA_VERSION:
        got = "none" if version is None else version.tolist()
        raise ValueError(f"schema_version: expected {SCHEMA_VERSION}; got {got}")
    expected = [field for field in StoredStates.__dataclass_fields__ if field not in arrays]
    if expected:
        raise ValueError(f"arrays: expected {', '.join(expected)} too; got {', '.join(arrays)}")
    names, vertices = arrays["names"], arrays["vertices_m"]
    if names.ndim != 1 or names.dtype.kind != "U":
        raise ValueError(f"names: expected text [n]; got {names.dtype} {list(names.shape)}")
    if vertices.ndim != 3:
        raise ValueError(f"vertices_m: expected 3 axes; got {list(vertices.shape)}")
    return StoredStates(
        str(arrays["task"]),
        str(arrays["garment"]),
        str(arrays["mesh_digest"]),
        tuple(names.tolist()),
        arrays["seeds"],
        np.ascontiguousarray(vertices.transpose(0, 2, 1)),
    )


def _check_array(
    name: str,
    array: NDArray[Any],
    dtype: np.dtype[Any],
    shape: tuple[int | None, ...],
) -> None:
    fits = len(array.shape) == len(shape) and all(
        length == expected or (expected is None and length > 0)
        for length, expected in zip(array.shape, shape, strict=True)
    )
    if not fits or array.dtype != dtype or array.size == 0:
        lengths = ", ".join("n >= 1" if length is None else str(length) for length in shape)
        raise ValueError(
            f"{name}: expected {dtype} [{lengths}] and at least one state; got {array.dtype} "
            f"{list(array.shape)}"
        )


def _described(name: str, mesh: ClothMesh) -> str:
    return f"{name}, {len(mesh.vertices_m)} vertices"
