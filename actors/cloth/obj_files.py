"""Wavefront OBJ files: how PyBullet wants meshes, and how users give their own garments.

A user's mesh must be one flat layer. Whatever would make a simulated cloth tear, explode or pass
through itself is refused here, by the name of the file and with what to do.
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from actors.cloth.meshes import ClothMesh

SMALLEST_M = 0.05
LARGEST_M = 1.0  # the table is 1.2 m wide
FLAT_PORTION = 0.02
"""A flat garment's height is at most this portion of its length."""
LEAST_ANGLE_DEG = 12.0
LONGEST_EDGE = 3.0
"""No edge may be longer than this many typical ones: there would be a hole in the vertices."""
MOST_VERTICES = 5000
_SAME_POINT = 1e-6


class ObjFileError(ValueError):
    """A file is no OBJ file, or its mesh cannot be a piece of cloth."""


@dataclass(frozen=True)
class _Source:
    """Where a complaint is about."""

    path: Path

    def refuse(self, expected: str, got: str, what_to_do: str) -> ObjFileError:
        return ObjFileError(f"{self.path}: expected {expected}; got {got}; {what_to_do}")


def write_obj(mesh: ClothMesh, path: Path) -> None:
    """Write the mesh as a Wavefront OBJ file, whose vertex ids begin at 1."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices_m]
    lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def read_obj(path: Path, *, metres_per_unit: float = 1.0) -> ClothMesh:
    """A flat garment from a file: centred, laid onto z = 0, front side up.

    Polygons are cut into triangles, vertices at the same place become one, and the thinnest of the
    three axes becomes the height, with the others in cyclic order, so that nothing is mirrored.
    Textures, normals, groups and materials are passed over.

    Args:
        path: the file.
        metres_per_unit: its scale, 0.01 for a file in centimetres.

    Raises:
        OSError: it cannot be read.
        ObjFileError: it is not such a file, or not one flat, connected layer of well-shaped
            triangles whose size fits the table.
    """
    source = _Source(path)
    if not 0.0 < metres_per_unit < np.inf:
        raise ValueError(
            f"metres_per_unit: expected a positive number; got {metres_per_unit}; 0.01 is right "
            "for a file in centimetres"
        )
    points, faces = _parsed(path.read_text(encoding="utf-8", errors="replace"), source)
    points, faces = _merged(points * metres_per_unit, faces)
    vertices_m = _laid_flat(points, source)
    faces = _fronts_up(vertices_m, faces, source)
    mesh = ClothMesh(vertices_m, faces)
    _check_one_layer(mesh, source)
    _check_triangles(mesh, source)
    return mesh


def _parsed(text: str, source: _Source) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    points: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        keyword, *words = line.partition("#")[0].split() or [""]
        try:
            if keyword == "v":
                points.append([float(word) for word in words[:3]])
                if len(points[-1]) < 3:
                    raise ValueError("three coordinates")
            elif keyword == "f":
                faces += _triangles(words, len(points))
        except ValueError as error:
            raise source.refuse(
                "'v x y z' and 'f a b c ...' lines with ids that exist already",
                f"{line.strip()[:60]!r} in line {number} ({error})",
                "export the mesh again",
            ) from None
    if not faces:
        raise source.refuse(
            "a mesh with faces", f"{len(points)} vertices and no face", "export it with its faces"
        )
    if len(points) > MOST_VERTICES:
        raise source.refuse(
            f"at most {MOST_VERTICES} vertices", str(len(points)), "simplify the mesh"
        )
    array = np.array(points)
    if not np.isfinite(array).all():
        raise source.refuse("finite coordinates", "a NaN or an infinity", "export the mesh again")
    return array, np.array(faces, dtype=np.int32)


def _triangles(words: list[str], n_points: int) -> list[tuple[int, int, int]]:
    """A polygon's fan; ids from 1, or negative from the end."""
    ids = []
    for word in words:
        given = int(word.partition("/")[0])
        index = given - 1 if given > 0 else n_points + given
        if given == 0 or not 0 <= index < n_points:
            raise ValueError(f"there is no vertex {given}")
        ids.append(index)
    if len(ids) < 3:
        raise ValueError("three vertices make a face")
    return [(ids[0], b, c) for b, c in pairwise(ids[1:])]


def _merged(
    points: NDArray[np.float64], faces: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Without double vertices, which exporters make along texture seams, and unused ones."""
    size = max(float(np.ptp(points, axis=0).max()), 1e-12)
    cells = np.rint(points / (size * _SAME_POINT)).astype(np.int64)
    _, first, place = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    used, corners = np.unique(place.reshape(-1)[faces], return_inverse=True)
    return points[first[used]], corners.reshape(-1, 3).astype(np.int32)


def _laid_flat(points: NDArray[np.float64], source: _Source) -> NDArray[np.float64]:
    extents = np.ptp(points, axis=0)
    thin, length_m = int(extents.argmin()), float(extents.max())
    if extents[thin] > FLAT_PORTION * length_m:
        raise source.refuse(
            f"a flat mesh, its height at most {FLAT_PORTION:.0%} of its length",
            f"{extents[thin]:.3g} m of {length_m:.3g} m",
            "lay the garment flat and keep one layer of it",
        )
    if not SMALLEST_M <= length_m <= LARGEST_M:
        raise source.refuse(
            f"a garment of {SMALLEST_M} to {LARGEST_M} m",
            f"{length_m:.3g} m",
            "give its scale as metres_per_unit, such as 0.01 for centimetres",
        )
    # In cyclic order, so that the garment is turned and not mirrored.
    across, up = points[:, (thin + 1) % 3], points[:, (thin + 2) % 3]
    flat = np.stack([across, up], axis=1)
    flat -= (flat.min(axis=0) + flat.max(axis=0)) / 2
    return np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)


def _fronts_up(
    vertices_m: NDArray[np.float64], faces: NDArray[np.int32], source: _Source
) -> NDArray[np.int32]:
    areas = _twice_areas(vertices_m, faces)
    empty = int((np.abs(areas) < 1e-12).sum())
    if empty:
        raise source.refuse("triangles with an area", f"{empty} without", "remove degenerate faces")
    turned: NDArray[np.int32] = np.where((areas < 0)[:, None], faces[:, ::-1], faces)
    return np.ascontiguousarray(turned)


def _check_one_layer(mesh: ClothMesh, source: _Source) -> None:
    """Each edge once in either direction, each vertex in one fan, and everything connected."""
    sides = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    _, counts = np.unique(sides, axis=0, return_counts=True)
    if (counts > 1).any():
        raise source.refuse(
            "one layer: an edge between at most two triangles, on either side of it",
            f"{int((counts > 1).sum())} edges with overlapping triangles",
            "remove the second layer; the cloth's inner side needs none",
        )
    pieces = _pieces(mesh)
    if pieces > 1:
        raise source.refuse(
            "one connected piece", f"{pieces} pieces", "join them, or keep one of them"
        )
    pinched = _vertices_of_several_fans(mesh)
    if pinched:
        raise source.refuse(
            "triangles that meet in edges",
            f"{pinched} vertices where they only touch",
            "widen the mesh there",
        )


def _pieces(mesh: ClothMesh) -> int:
    label = np.arange(len(mesh.vertices_m))
    while True:
        lowest = np.minimum(label[mesh.edges[:, 0]], label[mesh.edges[:, 1]])
        before = label.copy()
        np.minimum.at(label, mesh.edges[:, 0], lowest)
        np.minimum.at(label, mesh.edges[:, 1], lowest)
        label = label[label]
        if np.array_equal(label, before):
            return len(np.unique(label))


def _vertices_of_several_fans(mesh: ClothMesh) -> int:
    """In a manifold layer a vertex has as many triangles as edges, or on the rim one fewer."""
    n_vertices = len(mesh.vertices_m)
    n_edges = np.bincount(mesh.edges.reshape(-1), minlength=n_vertices)
    n_faces = np.bincount(mesh.faces.reshape(-1), minlength=n_vertices)
    return int((n_edges - n_faces > 1).sum())


def _check_triangles(mesh: ClothMesh, source: _Source) -> None:
    angles_deg = _least_angles_deg(mesh)
    poor = int((angles_deg < LEAST_ANGLE_DEG).sum())
    if poor:
        raise source.refuse(
            f"angles of at least {LEAST_ANGLE_DEG:g} degrees",
            f"{poor} of {len(mesh.faces)} triangles below, the sharpest {angles_deg.min():.1f}",
            "remesh it with triangles of even shape",
        )
    longest = float(mesh.rest_edge_lengths_m.max()) / mesh.spacing_m
    if longest > LONGEST_EDGE:
        raise source.refuse(
            f"edges of at most {LONGEST_EDGE:g} times the typical length",
            f"{longest:.1f} times",
            "remesh it with triangles of even size",
        )


def _least_angles_deg(mesh: ClothMesh) -> NDArray[np.float64]:
    corners = mesh.vertices_m[mesh.faces]
    to_next = np.roll(corners, -1, axis=1) - corners
    to_next /= np.linalg.norm(to_next, axis=2, keepdims=True)
    cosines = -(to_next * np.roll(to_next, 1, axis=1)).sum(axis=2)
    return np.asarray(np.rad2deg(np.arccos(np.clip(cosines, -1.0, 1.0))).min(axis=1))


def _twice_areas(vertices_m: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    a, b, c = (vertices_m[faces[:, k], :2] for k in range(3))
    one, two = b - a, c - a
    return np.asarray(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
