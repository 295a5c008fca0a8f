"""Folding a t-shirt by picking it up and dropping it, with coloured markers at sleeves and hem."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.garments import Garment
from actors.cloth.gestures import Gesture
from actors.cloth.markers import TSHIRT_MARKERS, found_markers, painted
from actors.cloth.pick_points import extreme_pick_points
from actors.cloth.rasteriser import ClothColours, Paint, draw_cloth
from actors.envs.cloth_options import ClothTaskOptions
from actors.envs.cloth_task import ClothTaskEnv
from actors.envs.fold_targets import USUAL_FOLDING, FoldTarget, FoldThresholds, scripted_target
from actors.envs.planned_actions import PlannedAction, planned_pick_and_drop
from actors.envs.tshirt_reward import RewardForm, TshirtReward

VIEW_HALF_WIDTH_M: Final = 0.32
"""The hem of the spread t-shirt is then seen where algorithm 3 has it at first."""

_COLUMNS: Final = (0.15, 0.325, 0.5, 0.675, 0.85)
_ROWS: Final = (0.208, 0.405, 0.603, 0.8)
DROP_POINTS_M: Final = tuple(
    ((2 * x - 1) * VIEW_HALF_WIDTH_M, (1 - 2 * y) * VIEW_HALF_WIDTH_M)
    for y in _ROWS
    for x in _COLUMNS
)
"""5 x 4 points of the table, from the picture's top left, row by row. **assumed**: that they hold
algorithm 3's initial and target points of the hem."""

N_PICK_POINTS: Final = 10
SCRIPT: Final = ((2, 7), (6, 7), (4, 2))
"""Pick and drop points of a good fold: right sleeve in, left sleeve in, middle of the hem up."""

COLOURS: Final = ClothColours(front=(50, 80, 190), back=(120, 150, 225))
THRESHOLDS: Final = FoldThresholds(0.75, 0.05)


@dataclass(frozen=True)
class PickAndDrop:
    """A step of a script: from a pick point of the current picture to a drop point."""

    pick: int
    drop: int

    def gesture(self, vertices_in_world: NDArray[np.float64], garment: Garment) -> Gesture:
        """The step, planned on the task's usual picture."""
        picture = draw_cloth(vertices_in_world, garment.mesh.faces, _EYE, COLOURS)
        pick_px = extreme_pick_points(picture)[self.pick]
        drop_xy_m = DROP_POINTS_M[self.drop]
        return planned_pick_and_drop(vertices_in_world, _EYE, pick_px, drop_xy_m).gesture


_EYE: Final = Camera(view_half_width_m=VIEW_HALF_WIDTH_M)


class TshirtFoldEnv(ClothTaskEnv):
    """T-shirt folding: `clothbus/TShirtFold-v0`.

    Action: pick point * 20 + drop point; the pick points are the outermost ones of the current
    cloth in 8 directions and 2 inside. Reward: algorithm 3, from markers found in the observation.

    Measures: `success` (IoU and mean particle distance to a scripted fold within thresholds; never
    the reward), `iou`, `particle_distance_m`, `sleeves_folded`, `markers` (where they are seen);
    after a step `pick_px` and `drop_xy_m`.

    Source: table 3.3a and algorithm 3.
    """

    def __init__(
        self, *, reward_form: RewardForm = "corrected", options: ClothTaskOptions | None = None
    ) -> None:
        """Make the task; see `ClothTaskEnv`.

        Args:
            reward_form: "corrected", or "literal" as algorithm 3 is printed.
            options: what was chosen.

        Raises:
            ValueError: an argument is out of the rule.
        """
        self._reward_form: RewardForm = reward_form
        self._reward = TshirtReward(reward_form)
        n_actions = N_PICK_POINTS * len(DROP_POINTS_M)
        given = options or ClothTaskOptions(horizon=8, view_half_width_m=VIEW_HALF_WIDTH_M)
        super().__init__("tshirt", n_actions, given, COLOURS, USUAL_FOLDING)

    def _begin(self) -> None:
        self._reward = TshirtReward(self._reward_form)

    def _paint(self, garment: Garment, colours: ClothColours) -> Paint:
        return painted(garment, colours, TSHIRT_MARKERS)

    def _plan(self, action: int) -> PlannedAction:
        pick, drop = divmod(action, len(DROP_POINTS_M))
        scene = self._scene
        pick_px = extreme_pick_points(scene.picture)[pick]
        return planned_pick_and_drop(
            scene.vertices_in_world(), scene.look.camera, pick_px, DROP_POINTS_M[drop]
        )

    def _judge(self) -> tuple[float, dict[str, Any]]:
        seen = found_markers(self._scene.picture, TSHIRT_MARKERS)
        reward = self._reward(seen)
        return reward, self._target().measures(self._scene, THRESHOLDS) | {
            "sleeves_folded": self._reward.sleeves_folded(seen),
            "markers": seen,
        }

    def _target(self) -> FoldTarget:
        return scripted_target(self._scene.garment, tuple(PickAndDrop(*step) for step in SCRIPT))
