"""What a garment looks like when it is folded well: scripted folds, made on the fast engine."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.engine import ClothEngineError
from actors.cloth.garments import Garment
from actors.cloth.gestures import Gesture
from actors.cloth.guard import guard
from actors.cloth.masks import cloth_mask
from actors.cloth.measures import aligned_iou, mean_particle_distance_m
from actors.cloth.meshes import refined
from actors.cloth.rasteriser import draw_cloth
from actors.cloth.xpbd_engine import XpbdEngine
from actors.cloth.xpbd_settings import XpbdSettings
from actors.envs.scene import Scene

FOLDING_XPBD: Final[dict[str, Any]] = {
    "table_friction": 1.0,
    "bending_compliance": 1e-4,
    "longest_settling_secs": 0.5,
}
"""With less friction cloth slides under the fold; stiffer, small folds spring open; looked at
earlier, they still do."""


FOLDING_PYBULLET: Final[dict[str, Any]] = {"bending_stiffness": 0.2, "friction": 1.0}
"""Stiffer, a sleeve that was folded in springs open again; looked at."""

USUAL_FOLDING: Final = {"xpbd": FOLDING_XPBD, "pybullet": FOLDING_PYBULLET}
"""By engine."""

_COARSEST_SPACING_M: Final = 0.02
"""Of a mesh that folds flat enough for a target. PyBullet's are coarser: folded on one of them, a
shirt stood 8 cm high, with a sleeve beside it."""


@dataclass(frozen=True)
class FoldThresholds:
    """How like its target a garment must be to count as folded."""

    least_iou: float
    most_distance_m: float


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

    def measures(self, scene: Scene, thresholds: FoldThresholds) -> dict[str, Any]:
        """`success`, `iou` and `particle_distance_m` of the scene's garment, for `info`."""
        iou = self.iou(scene.mask, scene.look.camera)
        distance_m = self.distance_m(scene.vertices_in_world())
        folded = iou >= thresholds.least_iou and distance_m <= thresholds.most_distance_m
        return {"success": folded, "iou": iou, "particle_distance_m": distance_m}


class FoldStep(Protocol):
    """One step of a script: hashable, so that a target is made once."""

    def gesture(self, vertices_in_world: NDArray[np.float64], garment: Garment) -> Gesture:
        """What hands do to the garment as it lies now."""
        ...


@lru_cache(maxsize=64)
def scripted_target(garment: Garment, script: tuple[FoldStep, ...]) -> FoldTarget:
    """The garment after a script, from spread out in the middle of the table.

    A mesh that is too coarse to fold flat is refined for it; its own vertices are where they are
    then.

    Raises:
        ClothEngineError: a step broke the cloth.
    """
    fine = garment
    while fine.mesh.spacing_m > _COARSEST_SPACING_M:
        fine = replace(fine, mesh=refined(fine.mesh))
    engine = XpbdEngine(XpbdSettings(**FOLDING_XPBD))
    engine.reset(fine.mesh)
    for step in script:
        engine.perform(step.gesture(engine.vertices_in_world(), fine))
    vertices = engine.vertices_in_world()
    if reason := guard(fine.mesh, vertices):
        raise ClothEngineError(
            f"target of {garment.name}: expected a sound cloth after the script {script}; got "
            f"{reason}; choose another script, or a mesh with smaller triangles"
        )
    return FoldTarget(garment, vertices[: len(garment.mesh.vertices_m)])
