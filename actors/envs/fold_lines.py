"""Folding shirts and trousers along lines, and the handkerchief of the appendix."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.fold_lines import N_FOLD_LINES, fold, plan_fold
from actors.cloth.garments import Garment, GarmentKind
from actors.cloth.gestures import Gesture
from actors.cloth.masks import cloth_mask
from actors.cloth.rasteriser import HANDKERCHIEF_COLOURS, ClothColours, draw_cloth
from actors.envs.cloth_options import ClothTaskOptions
from actors.envs.cloth_task import ClothTaskEnv
from actors.envs.fold_targets import USUAL_FOLDING, FoldTarget, FoldThresholds, scripted_target
from actors.envs.planned_actions import PlannedAction, planned_fold


@dataclass(frozen=True)
class FoldTask:
    """A garment and how it is folded well."""

    kind: GarmentKind
    lines: tuple[int, ...]
    """The lines that may be chosen, by action; see `actors.cloth.fold_lines`."""

    script: tuple[int, ...]
    """The actions of the scripted expert, in order: they make the target."""

    thresholds: FoldThresholds
    colours: ClothColours


@dataclass(frozen=True)
class FoldAlong:
    """A step of a script: fold along a line of the current outline."""

    line: int

    def gesture(self, vertices_in_world: NDArray[np.float64], garment: Garment) -> Gesture:
        """The fold, planned on a picture of twice the usual size."""
        mask = cloth_mask(draw_cloth(vertices_in_world, garment.mesh.faces, _SHARP_EYE))
        return fold(vertices_in_world, plan_fold(mask, _SHARP_EYE, self.line))


_SHARP_EYE: Final = Camera(size_px=168, view_half_width_m=0.35)
ALL_LINES: Final = tuple(range(N_FOLD_LINES))
SHIRT_COLOURS: Final = ClothColours(front=(60, 90, 190), back=(150, 180, 235))
TROUSERS_COLOURS: Final = ClothColours(front=(150, 90, 40), back=(215, 170, 110))

FOLD_TASKS: Final[Mapping[str, FoldTask]] = {
    "shirt": FoldTask("shirt", ALL_LINES, (0, 2, 4), FoldThresholds(0.85, 0.025), SHIRT_COLOURS),
    "trousers": FoldTask(
        "trousers", ALL_LINES, (1, 4), FoldThresholds(0.85, 0.025), TROUSERS_COLOURS
    ),
    "handkerchief": FoldTask(
        "handkerchief", (4, 1, 2), (0, 1), FoldThresholds(0.8, 0.03), HANDKERCHIEF_COLOURS
    ),
}
"""By name. The handkerchief's lines fold up, right and left; its target is up, then right."""


class FoldLinesEnv(ClothTaskEnv):
    """Folding along lines: `clothbus/ShirtFold-v0`, `TrousersFold-v0` and `HandkerchiefFold-v0`.

    Action: which line; lines, grasp points and paths follow from the current outline, see
    `actors.cloth.fold_lines`. Reward: the IoU with the target mask, wherever it lies.

    Measures: `success` (IoU and mean particle distance within the task's thresholds), `iou`,
    `particle_distance_m`; after a step `fold_line_m`, `grasps_m` and `drops_m`.

    Source: table 4.4a; the appendix for the handkerchief. **assumed**: the reward, which the source
    leaves out, and everything of the lines that `actors.cloth.fold_lines` says.
    """

    def __init__(self, garment: str, *, options: ClothTaskOptions | None = None) -> None:
        """Make the task; see `ClothTaskEnv`.

        Args:
            garment: "shirt", "trousers" or "handkerchief".
            options: what was chosen.

        Raises:
            ValueError: an argument is out of the rule.
        """
        if garment not in FOLD_TASKS:
            raise ValueError(
                f"garment: expected one of {', '.join(FOLD_TASKS)}; got {garment!r}; "
                "name one of them"
            )
        self.task = FOLD_TASKS[garment]
        super().__init__(
            self.task.kind,
            len(self.task.lines),
            options or ClothTaskOptions(),
            self.task.colours,
            USUAL_FOLDING,
        )

    def _plan(self, action: int) -> PlannedAction:
        scene = self._scene
        plan = plan_fold(scene.mask, scene.look.camera, self.task.lines[action])
        return planned_fold(scene.vertices_in_world(), scene.look.camera, plan)

    def _judge(self) -> tuple[float, dict[str, Any]]:
        measures = self._target().measures(self._scene, self.task.thresholds)
        return measures["iou"], measures

    def _target(self) -> FoldTarget:
        script = tuple(FoldAlong(self.task.lines[action]) for action in self.task.script)
        return scripted_target(self._scene.garment, script)
