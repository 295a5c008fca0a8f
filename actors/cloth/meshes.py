"""Triangle meshes of cloth that lies flat."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class ClothMesh:
    """A flat piece of cloth at rest, front side up."""

    vertices_m: NDArray[np.float64]
    """f64[V, 3], metres, centred on the origin; the front side faces +z."""

    faces: NDArray[np.int32]
    """i32[F, 3], vertex ids, counter-clockwise seen from the front side."""

    def __post_init__(self) -> None:
        """Check both arrays.

        Raises:
            ValueError: a shape, a dtype or a vertex id is out of the rule.
        """
        _check_array("ClothMesh.vertices_m", self.vertices_m, np.dtype(np.float64))
        _check_array("ClothMesh.faces", self.faces, np.dtype(np.int32))
        n_vertices = len(self.vertices_m)
        if self.faces.min() < 0 or self.faces.max() >= n_vertices:
            raise ValueError(
                f"ClothMesh.faces: expected vertex ids from 0 to {n_vertices - 1}; "
                f"got {self.faces.min()} to {self.faces.max()}; number vertices from 0"
            )

    @cached_property
    def edges(self) -> NDArray[np.int32]:
        """i32[E, 2], each edge of a triangle once, sorted."""
        sides = np.concatenate(
            [self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]
        )
        return np.unique(np.sort(sides, axis=1), axis=0)

    @cached_property
    def rest_edge_lengths_m(self) -> NDArray[np.float64]:
        """f64[E], the length of each edge while nothing pulls at it, in the order of `edges`."""
        return edge_lengths_m(self.vertices_m, self.edges)

    @cached_property
    def spacing_m(self) -> float:
        """The length of a typical edge: their median."""
        return float(np.median(self.rest_edge_lengths_m))


def edge_lengths_m(
    vertices_m: NDArray[np.float64], edges: NDArray[np.int32]
) -> NDArray[np.float64]:
    """Length of each edge, f64[E], for vertices f64[V, 3] and edges i32[E, 2]."""
    lengths_m: NDArray[np.float64] = np.linalg.norm(
        vertices_m[edges[:, 0]] - vertices_m[edges[:, 1]], axis=1
    )
    return lengths_m


def refined(mesh: ClothMesh) -> ClothMesh:
    """The same cloth with each triangle cut into four of half its size.

    The vertices of the mesh come first, in their order; then one in the middle of each edge, in the
    order of `edges`.
    """
    edges = mesh.edges
    middles_m = mesh.vertices_m[edges].mean(axis=1)
    middle_of = {
        tuple(edge): len(mesh.vertices_m) + number for number, edge in enumerate(edges.tolist())
    }
    faces = []
    for a, b, c in mesh.faces.tolist():
        ab, bc, ca = (middle_of[min(ends), max(ends)] for ends in ((a, b), (b, c), (c, a)))
        faces += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    vertices_m = np.concatenate([mesh.vertices_m, middles_m])
    return ClothMesh(vertices_m, np.array(faces, dtype=np.int32))


def rectangular_sheet(vertices_per_side: int, size_m: float) -> ClothMesh:
    """A square sheet of n x n vertices, row by row from (-x, -y), with alternating diagonals.

    The diagonals alternate so that the sheet is equally stiff along both of its diagonals.

    Raises:
        ValueError: fewer than 2 vertices a side, or a size that is not positive.
    """
    if vertices_per_side < 2:
        raise ValueError(
            f"vertices_per_side: expected at least 2; got {vertices_per_side}; 12 is usual"
        )
    if not 0.0 < size_m < np.inf:
        raise ValueError(f"size_m: expected a positive length; got {size_m}; 0.3 is usual")
    ticks_m = np.linspace(-size_m / 2, size_m / 2, vertices_per_side)
    y_m, x_m = np.meshgrid(ticks_m, ticks_m, indexing="ij")
    vertices_m = np.stack([x_m, y_m, np.zeros_like(x_m)], axis=-1).reshape(-1, 3)
    return ClothMesh(vertices_m, _sheet_faces(vertices_per_side))


def _sheet_faces(n: int) -> NDArray[np.int32]:
    row, column = np.divmod(np.arange((n - 1) ** 2), n - 1)
    a = row * n + column
    b, c, d = a + 1, a + n, a + n + 1
    rising = np.stack([a, b, d, a, d, c], axis=1)
    falling = np.stack([a, b, c, b, d, c], axis=1)
    odd = (row + column) % 2 == 1
    return np.where(odd[:, None], rising, falling).reshape(-1, 3).astype(np.int32)


def _check_array(name: str, array: NDArray[np.generic], dtype: np.dtype[np.generic]) -> None:
    if array.ndim == 2 and array.shape[1] == 3 and len(array) > 0 and array.dtype == dtype:
        return
    raise ValueError(
        f"{name}: expected {dtype} [n >= 1, 3]; got {array.dtype} {list(array.shape)}; "
        "build meshes with the functions of actors.cloth.meshes"
    )
