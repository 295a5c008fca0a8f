"""What keeps a cloth's vertices apart and together: distances that follow from its mesh."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from actors.cloth.meshes import ClothMesh
from actors.cloth.xpbd_settings import XpbdSettings

LONG_EDGE = 1.2
"""Edges longer than this many spacings are diagonals: they resist shear, not stretch."""
SHORT_DIAGONAL = 1.6
"""Opposite vertices of two triangles at most this many spacings apart are the other diagonal."""
STRAIGHT = 0.98
"""Cosine of the angle between two edges that count as one line."""


@dataclass(frozen=True, eq=False)
class DistanceConstraints:
    """Pairs of vertices that want to be at their distance at rest."""

    pairs: NDArray[np.int32]
    """i32[C, 2], in the order in which they are solved."""
    rest_lengths_m: NDArray[np.float64]
    """f64[C]."""
    compliances: NDArray[np.float64]
    """f64[C]."""


def distance_constraints(mesh: ClothMesh, settings: XpbdSettings) -> DistanceConstraints:
    """Threads, diagonals and bending of a mesh, in a random but fixed order.

    In the mesh's own order each sweep would push errors in one direction.
    """
    is_long = mesh.rest_edge_lengths_m > LONG_EDGE * mesh.spacing_m
    across, bends = _opposite_vertices(mesh, SHORT_DIAGONAL * mesh.spacing_m)
    kinds = [
        (mesh.edges[~is_long], settings.stretch_compliance),
        (np.concatenate([mesh.edges[is_long], across]), settings.shear_compliance),
        (_united(bends, _two_apart_on_a_line(mesh)), settings.bending_compliance),
    ]
    pairs = np.concatenate([ids for ids, _ in kinds]).astype(np.int32)
    compliances = np.concatenate([np.full(len(ids), value) for ids, value in kinds])
    order = np.random.default_rng(0).permutation(len(pairs))
    pairs, compliances = np.ascontiguousarray(pairs[order]), compliances[order]
    ends = mesh.vertices_m[pairs]
    lengths_m = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    return DistanceConstraints(pairs, lengths_m, compliances)


def _opposite_vertices(
    mesh: ClothMesh, longest_diagonal_m: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Opposite vertices of two triangles with a common edge: those close, and those far apart.

    Close ones are the other diagonal of a cell and resist shear, the others resist bending over the
    edge. Either i32[K, 2].
    """
    opposite: dict[tuple[int, int], list[int]] = {}
    for a, b, c in mesh.faces.tolist():
        for one, two, third in ((a, b, c), (b, c, a), (c, a, b)):
            opposite.setdefault((min(one, two), max(one, two)), []).append(third)
    edges = set(map(tuple, mesh.edges.tolist()))
    found = {(min(pair), max(pair)) for pair in opposite.values() if len(pair) == 2}
    ids = np.array(sorted(found - edges), np.int32).reshape(-1, 2)
    ends = mesh.vertices_m[ids]
    is_short = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) < longest_diagonal_m
    return ids[is_short], ids[~is_short]


def _united(one: NDArray[np.int32], two: NDArray[np.int32]) -> NDArray[np.int32]:
    return np.unique(np.concatenate([one, two]), axis=0)


def _two_apart_on_a_line(mesh: ClothMesh) -> NDArray[np.int32]:
    """Vertices joined by two edges that lie on one line, i32[K, 2]."""
    around = _adjacent(mesh)
    found = set()
    for middle, ends in enumerate(around):
        here = mesh.vertices_m[middle]
        for left in ends:
            for right in ends:
                if left >= right or right in around[left]:
                    continue
                one, two = here - mesh.vertices_m[left], mesh.vertices_m[right] - here
                if one @ two > STRAIGHT * np.linalg.norm(one) * np.linalg.norm(two):
                    found.add((left, right))
    return np.array(sorted(found), np.int32).reshape(-1, 2)


def _adjacent(mesh: ClothMesh) -> list[set[int]]:
    around: list[set[int]] = [set() for _ in mesh.vertices_m]
    for a, b in mesh.edges.tolist():
        around[a].add(b)
        around[b].add(a)
    return around
