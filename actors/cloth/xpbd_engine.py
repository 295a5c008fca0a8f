"""The fast engine: XPBD cloth that repeats itself bit by bit and returns to any saved state."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from actors.cloth.engine import (
    TABLE_HALF_WIDTH_M,
    ClothEngineError,
    Film,
    checked_vertices,
)
from actors.cloth.gestures import Gesture, hand_paths_in_world, turns_in_world
from actors.cloth.meshes import ClothMesh
from actors.cloth.xpbd_constraints import distance_constraints
from actors.cloth.xpbd_settings import XpbdSettings
from actors.cloth.xpbd_solver import (
    Body,
    Distances,
    Numbers,
    advance,
    most_stretch,
    share_corrections,
)

FRAME_SECS = 1 / 60
"""How often it is looked whether the cloth has come to rest."""
RESTING_FRAMES = 3
"""So many slow frames in a row are rest: cloth that turns back is slow for one."""
SKIN_THICKNESSES = 1.0
SLIPS_AT = 1.7
"""Cloth that is stretched to so many times its length while fingers hold it slips out of them. Only
what is caught in itself resists a hand so much: carried on, it would tear."""
NEIGHBOUR_SPACINGS = 1.5
"""Vertices so close at rest, along a diagonal at most, never count as layers."""
ROOM_FOR_PAIRS = 64
"""Close pairs for each vertex; a crumpled handkerchief has about ten."""

_NOTHING = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class XpbdState:
    """All that the cloth's future depends on, besides its mesh and settings."""

    mesh: ClothMesh
    positions_m: NDArray[np.float64]
    """f64[V, 3]."""
    velocities_m_per_s: NDArray[np.float64]
    """f64[V, 3]."""


@dataclass
class XpbdEngine:
    """Cloth of vertices that keep their distances; one thread, no random numbers.

    Equal calls give equal bits, in any process on any machine with the same CPU type.
    """

    settings: XpbdSettings = field(default_factory=XpbdSettings)

    def __post_init__(self) -> None:
        """Begin without cloth."""
        self._mesh: ClothMesh | None = None

    @property
    def mesh(self) -> ClothMesh:
        """The cloth at rest.

        Raises:
            ClothEngineError: before the first reset.
        """
        if self._mesh is None:
            raise ClothEngineError(
                "XpbdEngine: expected reset() first; got no cloth; call reset(mesh)"
            )
        return self._mesh

    def reset(self, mesh: ClothMesh, vertices_in_world: NDArray[np.float64] | None = None) -> None:
        """Put a new piece of cloth on the table; see `ClothEngine.reset`."""
        vertices = checked_vertices(mesh, vertices_in_world)
        if self._mesh is not mesh:
            self._prepare(mesh)
        vertices[:, 2] += self._numbers.thickness_m / 2
        self._place(vertices, np.zeros_like(vertices))
        self._settle(least_secs=0.0)

    def put(self, mesh: ClothMesh, vertices_in_world: NDArray[np.float64]) -> None:
        """Put cloth on the table as it lay; see `PlaceableClothEngine.put`."""
        vertices = checked_vertices(mesh, vertices_in_world)
        self.restore(XpbdState(mesh, vertices, np.zeros_like(vertices)))

    def vertices_in_world(self) -> NDArray[np.float64]:
        """Where the vertices are, f64[V, 3]: a copy; see `ClothEngine.vertices_in_world`."""
        _ = self.mesh
        return np.ascontiguousarray(self._body.positions_m.T)

    def perform(self, gesture: Gesture, film: Film | None = None) -> None:
        """Let hands move the cloth; see `ClothEngine.perform`."""
        gesture.check(len(self.mesh.vertices_m))
        grasped = np.concatenate([hand.grasped for hand in gesture.hands])
        path_m = self._grasped_path_m(gesture)
        self._hold(grasped)
        self._carry(grasped, path_m, film)
        self._hold(_NOTHING)
        self._body.velocities_m_per_s[:, grasped] = 0.0  # fingers stop before they open
        self._settle(gesture.motion.settle_secs)

    def save(self) -> XpbdState:
        """The whole state, independent of what the engine does next."""
        mesh, body = self.mesh, self._body
        return XpbdState(
            mesh,
            np.ascontiguousarray(body.positions_m.T),
            np.ascontiguousarray(body.velocities_m_per_s.T),
        )

    def restore(self, state: XpbdState) -> None:
        """Return to a state that `save` gave, also to that of another cloth."""
        if self._mesh is not state.mesh:
            self._prepare(state.mesh)
        self._place(state.positions_m, state.velocities_m_per_s)

    def close(self) -> None:
        """Forget the cloth; may be called twice."""
        self._mesh = None

    def _prepare(self, mesh: ClothMesh) -> None:
        settings = self.settings
        constraints = distance_constraints(mesh, settings)
        substep_secs = 1 / settings.substeps_per_sec
        thickness_m = settings.thickness_cells * mesh.spacing_m
        skin_m = SKIN_THICKNESSES * thickness_m
        cell_m = thickness_m + skin_m
        n_cells = int(2 * TABLE_HALF_WIDTH_M / cell_m) + 1
        self._distances = Distances(
            constraints.pairs.astype(np.uint32),
            constraints.rest_lengths_m**2,
            constraints.compliances / substep_secs**2,
            np.zeros((len(constraints.pairs), 2)),
            np.ascontiguousarray(mesh.vertices_m.T),
        )
        self._numbers = Numbers(
            substep_secs,
            thickness_m,
            settings.table_friction,
            settings.layer_friction,
            settings.damping_per_sec,
            settings.fastest_m_per_s,
            NEIGHBOUR_SPACINGS * mesh.spacing_m,
            -TABLE_HALF_WIDTH_M,
            cell_m,
            n_cells,
            skin_m,
        )
        self._body = _new_body(len(mesh.vertices_m), n_cells)
        self._mesh = mesh

    def _place(
        self, positions_m: NDArray[np.float64], velocities_m_per_s: NDArray[np.float64]
    ) -> None:
        body = self._body
        body.positions_m[:] = positions_m.T
        body.velocities_m_per_s[:] = velocities_m_per_s.T
        body.n_close_pairs[0] = -1
        self._hold(_NOTHING)

    def _hold(self, grasped: NDArray[np.int64]) -> None:
        """These vertices, and no others, go where hands take them."""
        self._body.inverse_masses[:] = 1.0
        self._body.inverse_masses[grasped] = 0.0
        share_corrections(self._body, self._distances)

    def _grasped_path_m(self, gesture: Gesture) -> NDArray[np.float64]:
        """Where each grasped vertex is after each substep, f64[K, k, 3]: rigid with its hand."""
        positions_m = self.vertices_in_world()
        firsts = [hand.grasped[0] for hand in gesture.hands]
        paths = hand_paths_in_world(positions_m[firsts], gesture, self._numbers.substep_secs)
        held_m = []
        for index, hand in enumerate(gesture.hands):
            offsets_m = positions_m[hand.grasped] - positions_m[hand.grasped[0]]
            if hand.turns_rad is None:
                turned_m = offsets_m[None]
            else:
                turned_m = offsets_m @ turns_in_world(hand, paths[:, index, 3]).swapaxes(1, 2)
            way_m = paths[:, index, None, :3] + turned_m
            # What is turned over must not be pushed into the table.
            too_deep_m = self._numbers.thickness_m / 2 - way_m[:, :, 2].min(axis=1)
            way_m[:, :, 2] += np.maximum(too_deep_m, 0.0)[:, None]
            held_m.append(way_m)
        return np.concatenate(held_m, axis=1)

    def _carry(
        self, grasped: NDArray[np.int64], path_m: NDArray[np.float64], film: Film | None
    ) -> None:
        """Take what is grasped along a path f64[K, k, 3], as long as the fingers can hold it."""
        substep_secs = self._numbers.substep_secs
        n_frame = round(FRAME_SECS / substep_secs)
        n_film = len(path_m) if film is None else max(1, round(film.every_secs / substep_secs))
        starts = sorted({*range(0, len(path_m), n_frame), *range(0, len(path_m), n_film)})
        for start, end in pairwise([*starts, len(path_m)]):
            if film is not None and start % n_film == 0:
                film.frames.append(self.vertices_in_world())
            self._advance(end - start, grasped, path_m[start:end])
            if end % n_frame == 0 and self._slips():
                return

    def _slips(self) -> bool:
        """Whether the cloth is stretched so much that it slips out of the fingers."""
        return bool(most_stretch(self._body, self._distances) > SLIPS_AT)

    def _settle(self, least_secs: float) -> None:
        """Waits until the cloth lies still, at least and at most for a time."""
        substeps = round(FRAME_SECS * self.settings.substeps_per_sec)
        least, most = least_secs / FRAME_SECS, self.settings.longest_settling_secs / FRAME_SECS
        frames = resting = 0
        while frames < least or (resting < RESTING_FRAMES and frames < most):
            speed = self._advance(substeps, _NOTHING, np.zeros((substeps, 0, 3)))
            frames += 1
            resting = resting + 1 if speed < self.settings.rest_speed_m_per_s else 0
        # What is left is creep; the next action then begins from the picture alone.
        self._body.velocities_m_per_s[:] = 0.0
        self._body.n_close_pairs[0] = -1

    def _advance(
        self, n_substeps: int, grasped: NDArray[np.int64], path_m: NDArray[np.float64]
    ) -> float:
        speed = advance(
            self._body,
            self._distances,
            self._numbers,
            grasped,
            np.ascontiguousarray(path_m),
            n_substeps,
        )
        if speed == np.inf:
            self._body.positions_m[:] = np.nan  # the guard sees a cloth that is no cloth any more
            return 0.0
        return float(speed)


def _new_body(n_vertices: int, n_cells: int) -> Body:
    return Body(
        positions_m=np.zeros((3, n_vertices)),
        velocities_m_per_s=np.zeros((3, n_vertices)),
        inverse_masses=np.ones(n_vertices),
        previous_m=np.zeros((3, n_vertices)),
        listed_at_m=np.zeros((3, n_vertices)),
        close_pairs=np.zeros((ROOM_FOR_PAIRS * n_vertices, 2), np.uint32),
        n_close_pairs=np.full(1, -1),
        cells=np.zeros(n_vertices, np.uint32),
        first_in_cell=np.zeros(n_cells * n_cells + 1, np.uint32),
        by_cell=np.zeros(n_vertices, np.uint32),
    )
