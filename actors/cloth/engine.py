"""What a cloth engine offers to the tasks, and what can go wrong in one."""

from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from actors.cloth.gestures import Gesture
from actors.cloth.meshes import ClothMesh

TABLE_HALF_WIDTH_M = 0.6
"""The table is a square around the world's origin; its top is the plane z = 0."""

StateT = TypeVar("StateT")


class ClothEngineError(RuntimeError):
    """An engine cannot go on: not reset, closed, or its simulator was lost."""


@dataclass
class Film:
    """What cloth does while it is carried, seen every so often."""

    every_secs: float
    frames: list[NDArray[np.float64]] = field(default_factory=list)
    """f64[V, 3] each, the first when hands have closed; an engine adds to them."""


class ClothEngine(Protocol):
    """One piece of cloth on a table, moved by the gestures of hands.

    World frame: origin at the middle of the table's top, x to the right and y upwards in the
    camera's picture, z up. Engines draw no random numbers: what they are given decides.
    """

    @property
    def mesh(self) -> ClothMesh:
        """The cloth at rest, as given to `reset`.

        Raises:
            ClothEngineError: before the first reset.
        """
        ...

    def reset(self, mesh: ClothMesh, vertices_in_world: NDArray[np.float64] | None = None) -> None:
        """Put a new piece of cloth on an empty table and let it come to rest.

        Args:
            mesh: the cloth; its edges give the lengths at rest.
            vertices_in_world: f64[V, 3], where its vertices are put, metres, with z = 0 on the
                table's top; None puts the mesh as it is in the middle of the table.

        Raises:
            ValueError: the vertices do not fit the mesh.
            ClothEngineError: the simulator cannot be started.
        """
        ...

    def vertices_in_world(self) -> NDArray[np.float64]:
        """Where the vertices are, f64[V, 3], metres: a copy.

        Raises:
            ClothEngineError: before the first reset.
        """
        ...

    def perform(self, gesture: Gesture, film: Film | None = None) -> None:
        """Let hands take hold, move and let go, and let the cloth come to rest.

        What a hand holds keeps its shape while it is carried.

        Args:
            gesture: of one hand or several, made for where the cloth is now.
            film: to be filled from closing to opening; it changes nothing else.

        Raises:
            ValueError: it names a vertex that the cloth lacks, or one for two hands.
            ClothEngineError: before the first reset, or the simulator was lost.
        """
        ...

    def close(self) -> None:
        """Give back what the engine holds; may be called twice."""
        ...


class RestorableClothEngine(ClothEngine, Protocol, Generic[StateT]):
    """An engine that can return to an earlier state exactly, bit by bit.

    PyBullet cannot: its own save and restore leave soft bodies out, and putting vertices back
    loses their velocities and contacts.
    """

    def save(self) -> StateT:
        """The whole state, independent of what the engine does next."""
        ...

    def restore(self, state: StateT) -> None:
        """Return to a state that `save` of this engine gave."""
        ...


@runtime_checkable
class PlaceableClothEngine(Protocol):
    """An engine that takes vertices over bit by bit, where `ClothEngine.reset` lets them settle."""

    def put(self, mesh: ClothMesh, vertices_in_world: NDArray[np.float64]) -> None:
        """Put cloth that came to rest earlier on an empty table, just as it lay.

        Args:
            mesh: the cloth.
            vertices_in_world: f64[V, 3], metres, as `ClothEngine.vertices_in_world` gave them.

        Raises:
            ValueError: the vertices do not fit the mesh.
        """
        ...


def checked_vertices(
    mesh: ClothMesh, vertices_in_world: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """The vertices that a reset begins with, f64[V, 3]: those given, else those of the mesh.

    Raises:
        ValueError: another shape than the mesh's, or numbers that are not finite.
    """
    if vertices_in_world is None:
        return mesh.vertices_m.copy()
    vertices = np.array(vertices_in_world, dtype=np.float64)
    if vertices.shape != mesh.vertices_m.shape or not np.isfinite(vertices).all():
        raise ValueError(
            f"vertices_in_world: expected finite f64 {list(mesh.vertices_m.shape)}; got "
            f"{list(vertices.shape)}, finite: {bool(np.isfinite(vertices).all())}; "
            "move the mesh's own vertices"
        )
    return vertices
