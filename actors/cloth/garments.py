"""The garments of the tasks: a mesh, the names of some of its vertices, and its symmetries."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from actors.cloth.meshes import ClothMesh, rectangular_sheet
from actors.cloth.obj_files import read_obj
from actors.cloth.outlines import (
    TSHIRT,
    HandkerchiefSizes,
    Outline,
    Point,
    ShirtSizes,
    TrousersSizes,
)
from actors.cloth.triangulation import triangulated

GarmentKind = Literal["handkerchief", "tshirt", "shirt", "trousers"]
GARMENT_KINDS: Final[tuple[GarmentKind, ...]] = get_args(GarmentKind)
SPACING_M: Final[dict[GarmentKind, float]] = {
    "handkerchief": 0.3 / 19,
    "tshirt": 0.015,
    "shirt": 0.015,
    "trousers": 0.015,
}
"""Of meshes of 400 to 500 vertices."""

COARSE_SPACING_M: Final[dict[GarmentKind, float]] = {
    "handkerchief": 0.3 / 11,
    "tshirt": 0.028,
    "shirt": 0.028,
    "trousers": 0.028,
}
"""Of meshes of at most 150 vertices: PyBullet's springs want no more."""

Sizes = HandkerchiefSizes | ShirtSizes | TrousersSizes
_DEFAULT_SIZES: Final[dict[GarmentKind, Sizes]] = {
    "handkerchief": HandkerchiefSizes(),
    "tshirt": TSHIRT,
    "shirt": ShirtSizes(),
    "trousers": TrousersSizes(),
}

_AS_NEAR = 0.5
"""A vertex belongs to the mirror image of another within so many spacings."""


@dataclass(frozen=True, eq=False)
class Symmetry:
    """A way to name the vertices of a garment anew so that it still is the same garment."""

    order: NDArray[np.int64]
    """i64[V]: vertex i takes the part of vertex `order[i]`."""

    mirrored: bool
    """Left and right change places: the world must be mirrored too for the cloth to look alike."""


@dataclass(frozen=True, eq=False)
class Garment:
    """A flat piece of clothing at rest."""

    name: str
    mesh: ClothMesh
    keypoints: Mapping[str, int] = field(default_factory=dict)
    """Vertex ids by name; those of `Outline.keypoints_m`."""

    @cached_property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """All quarter turns and mirrorings that map the mesh onto itself; first the identity."""
        quarters = [np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([[0.0, -1.0], [1.0, 0.0]])]
        quarters += [-quarters[0], -quarters[1]]
        mirror = np.diag([-1.0, 1.0])
        found = []
        for mirrored in (False, True):
            for turn in quarters:
                order = _order_after(self.mesh, turn @ mirror if mirrored else turn)
                if order is not None:
                    found.append(Symmetry(order, mirrored))
        return tuple(found)


def make_garment(
    kind: GarmentKind,
    *,
    sizes: Mapping[str, float] | None = None,
    spacing_m: float | None = None,
    scale: float = 1.0,
) -> Garment:
    """A garment from its lengths.

    Args:
        kind: a key of `SPACING_M`.
        sizes: lengths in metres and angles in rad by name, where they differ from the defaults;
            see `actors.cloth.outlines`.
        spacing_m: about how far apart its vertices are before it is scaled; by default `SPACING_M`.
        scale: the whole garment, mesh and all, is enlarged by this.

    Raises:
        ValueError: there is no such garment or length, a length is out of its rule, or the
            spacing does not do for the outline.
    """
    if kind not in GARMENT_KINDS:
        raise ValueError(
            f"garment: expected one of {', '.join(GARMENT_KINDS)}; got {kind!r}; name one of them, "
            "or read your own with garment_from_obj"
        )
    measured = _measured(_DEFAULT_SIZES[kind], sizes or {})
    outline = measured.outline()
    spacing_m = SPACING_M[kind] if spacing_m is None else spacing_m
    if not 0.0 < spacing_m < np.inf:
        raise ValueError(f"spacing_m: expected a positive length; got {spacing_m}; 0.015 is usual")
    if isinstance(measured, HandkerchiefSizes):
        mesh = rectangular_sheet(round(measured.side_m / spacing_m) + 1, measured.side_m)
    else:
        mesh = triangulated(outline, spacing_m)
    keypoints = _nearest_vertices(mesh, outline)
    return Garment(kind, ClothMesh(mesh.vertices_m * scale, mesh.faces), keypoints)


def usual_spacing_m(kind: GarmentKind, engine: str) -> float:
    """How far apart a garment's vertices are by default, for an engine of that name."""
    return (COARSE_SPACING_M if engine == "pybullet" else SPACING_M)[kind]


def garment_from_obj(
    path: Path, *, metres_per_unit: float = 1.0, keypoints_m: Mapping[str, Point] | None = None
) -> Garment:
    """A user's garment; see `read_obj` for what is checked and raised.

    Args:
        path: the OBJ file.
        metres_per_unit: its scale.
        keypoints_m: places on the garment as it is laid flat and centred, where rewards or
            measures speak of some.
    """
    mesh = read_obj(path, metres_per_unit=metres_per_unit)
    places = Outline(mesh.vertices_m[:, :2], dict(keypoints_m or {}))
    return Garment(path.stem, mesh, _nearest_vertices(mesh, places))


def _measured(defaults: Sizes, sizes: Mapping[str, float]) -> Sizes:
    unknown = sorted(set(sizes) - set(defaults.__dataclass_fields__))
    if unknown:
        raise ValueError(
            f"sizes: expected some of {', '.join(defaults.__dataclass_fields__)}; got "
            f"{', '.join(unknown)}; leave out what this garment lacks"
        )
    make: Callable[..., Sizes] = type(defaults)
    return make(**{**defaults.__dict__, **sizes})


def _nearest_vertices(mesh: ClothMesh, outline: Outline) -> dict[str, int]:
    return {
        name: int(np.linalg.norm(mesh.vertices_m[:, :2] - place, axis=1).argmin())
        for name, place in outline.keypoints_m.items()
    }


def _order_after(mesh: ClothMesh, isometry: NDArray[np.float64]) -> NDArray[np.int64] | None:
    """Which vertex each one falls on, i64[V]; None where the mesh does not fall on itself."""
    plane = mesh.vertices_m[:, :2]
    distances = np.linalg.norm((plane @ isometry.T)[:, None] - plane, axis=2)
    order = distances.argmin(axis=1)
    fits = distances[np.arange(len(order)), order].max() < _AS_NEAR * mesh.spacing_m
    return order if fits and len(np.unique(order)) == len(order) else None
