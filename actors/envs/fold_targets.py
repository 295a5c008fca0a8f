"""What a garment looks like when it is folded well: scripted folds, made on the fast engine."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.engine import ClothEngineError
from actors.cloth.fold_lines import fold, plan_fold
from actors.cloth.garments import Garment
from actors.cloth.guard import guard
from actors.cloth.masks import cloth_mask
from actors.cloth.measures import aligned_iou, mean_particle_distance_m
from actors.cloth.rasteriser import draw_cloth
from actors.cloth.xpbd_engine import XpbdEngine
from actors.cloth.xpbd_settings import XpbdSettings

FOLDING_XPBD: Final[dict[str, Any]] = {"table_friction": 1.0, "bending_compliance": 1e-4}
"""With less friction cloth slides under the fold; stiffer, small folds spring open."""

_EYE: Final = Camera(size_px=168, view_half_width_m=0.35)


@dataclass(frozen=True, eq=False)
class FoldTarget:
    """A well-folded garment."""

    garment: Garment
    vertices_in_world: NDArray[np.float64]
    """f64[V, 3], metres."""

    def mask(self, camera: Camera) -> NDArray[np.bool_]:
        """bool[size, size], what a camera would see of it."""
        return cloth_mask(draw_cloth(self.vertices_in_world, self.garment.mesh.faces, camera))

    def distance_m(self, vertices_in_world: NDArray[np.float64]) -> float:
        """The mean particle distance of a state from it; see `actors.cloth.measures`."""
        return mean_particle_distance_m(vertices_in_world, self.vertices_in_world, self.garment)

    def iou(self, mask: NDArray[np.bool_], camera: Camera) -> float:
        """The IoU of a mask with it, wherever both lie, bool[size, size] from that camera."""
        mirrored = any(symmetry.mirrored for symmetry in self.garment.symmetries)
        return aligned_iou(mask, self.mask(camera), may_mirror=mirrored)


@dataclass(frozen=True)
class FoldThresholds:
    """How like its target a garment must be to count as folded."""

    least_iou: float
    most_distance_m: float


def scripted_target(garment: Garment, lines: Sequence[int]) -> FoldTarget:
    """The garment after folds along lines of its current outline, from spread out.

    Args:
        garment: laid flat in the middle of the table.
        lines: which of the six, in order; see `actors.cloth.fold_lines`.

    Raises:
        ClothEngineError: a fold broke the cloth.
    """
    return _target(garment, tuple(lines))


@lru_cache(maxsize=16)
def _target(garment: Garment, lines: tuple[int, ...]) -> FoldTarget:
    engine = XpbdEngine(XpbdSettings(**FOLDING_XPBD))
    engine.reset(garment.mesh)
    for line in lines:
        vertices = engine.vertices_in_world()
        mask = cloth_mask(draw_cloth(vertices, garment.mesh.faces, _EYE))
        engine.perform(fold(vertices, plan_fold(mask, _EYE, line)))
    vertices = engine.vertices_in_world()
    if reason := guard(garment.mesh, vertices):
        raise ClothEngineError(
            f"target of {garment.name}: expected a sound cloth after the folds {lines}; got "
            f"{reason}; choose other lines, or a mesh with smaller triangles"
        )
    return FoldTarget(garment, vertices)
