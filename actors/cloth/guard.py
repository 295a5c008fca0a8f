"""Tells a cloth that a simulator has broken from one that merely lies badly."""

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from actors.cloth.engine import TABLE_HALF_WIDTH_M
from actors.cloth.meshes import ClothMesh, edge_lengths_m

MOST_STRETCH = 2.0  # knotted cloth comes to 1.6 and lives; an explosion knows no bound
LOWEST_M = -0.02  # soft contacts sink a few millimetres into the table
HIGHEST_M = 0.6  # twice the handkerchief's length; it is carried at 0.1


class GuardReason(StrEnum):
    """Why a step must not be learned from."""

    NOT_FINITE = "not_finite"
    """A coordinate is not a number or infinite."""

    OVERSTRETCHED = "overstretched"
    """An edge is longer than `MOST_STRETCH` times its length at rest."""

    OFF_TABLE = "off_table"
    """A vertex is beside the table, below its top, or far above it."""

    OUT_OF_VIEW = "out_of_view"
    """The camera sees no cloth, so that there is nothing to pick up."""

    ENGINE_LOST = "engine_lost"
    """The simulator stopped answering."""


def guard(mesh: ClothMesh, vertices_in_world: NDArray[np.float64]) -> GuardReason | None:
    """Why this state of the cloth cannot be right; None where it can.

    Args:
        mesh: the cloth at rest.
        vertices_in_world: f64[V, 3], metres, table top at z = 0.
    """
    if not np.isfinite(vertices_in_world).all():
        return GuardReason.NOT_FINITE
    stretch = edge_lengths_m(vertices_in_world, mesh.edges) / mesh.rest_edge_lengths_m
    if stretch.max() > MOST_STRETCH:
        return GuardReason.OVERSTRETCHED
    beside = np.abs(vertices_in_world[:, :2]).max() > TABLE_HALF_WIDTH_M
    heights_m = vertices_in_world[:, 2]
    away = heights_m.min() < LOWEST_M or heights_m.max() > HIGHEST_M
    return GuardReason.OFF_TABLE if beside or away else None
