"""Flipping a handkerchief by picking it up and dropping it, seen in a picture."""

from typing import Any, Final, Literal

from actors.cloth.masks import red_mask
from actors.cloth.pick_points import PickPoints, contour_pick_points, grid_pick_points
from actors.envs.arguments import check_range
from actors.envs.cloth_options import ClothTaskOptions
from actors.envs.cloth_task import ClothTaskEnv
from actors.envs.planned_actions import PlannedAction, planned_pick_and_drop

DROP_POINTS_M: Final = tuple((x_m, y_m) for y_m in (0.09, -0.09) for x_m in (-0.12, 0.0, 0.12))
"""2 x 3 points of the table, from the picture's top left, row by row. **assumed**"""

SUCCESS_PORTION: Final = 0.8
"""Least red area over the flat cloth's area. Source: chapter 4.3.1."""

PickRule = Literal["grid", "contour"]
PICK_RULES: Final[dict[PickRule, tuple[PickPoints, int]]] = {
    "grid": (grid_pick_points, 6),
    "contour": (contour_pick_points, 10),
}
"""Each rule's function and its number of points. Sources: chapters 3.3.1 and 4.3.1."""


class HandkerchiefFlipEnv(ClothTaskEnv):
    """Handkerchief flipping: `clothbus/HandkerchiefFlip36-v0` and `clothbus/HandkerchiefFlip60-v0`.

    Action: pick point * 6 + drop point; the pick points are found in the observation before, the
    drop points are fixed on the table. Reward: red pixels over all pixels, times `reward_scale`.
    The cloth is laid green side up.

    Measures: `success` (red area at least 0.8 of the flat cloth's) and `red_over_flat` (that
    portion); after a step `pick_px` (column, row) and `drop_xy_m`.

    Source: tables 3.2a and 4.2a. **assumed**: sizes, stiffness and the camera's view, which make
    the difficulty.
    """

    def __init__(
        self,
        pick_rule: PickRule,
        *,
        reward_scale: float = 1.0,
        options: ClothTaskOptions | None = None,
    ) -> None:
        """Make the task; see `ClothTaskEnv`.

        Args:
            pick_rule: "grid", 6 points over the cloth's area, or "contour", 10 along and inside
                of its outline.
            reward_scale: what the red portion of the picture is multiplied with.
            options: what was chosen.

        Raises:
            ValueError: an argument is out of the rule.
        """
        if pick_rule not in PICK_RULES:
            raise ValueError(
                f"pick_rule: expected {' or '.join(map(repr, PICK_RULES))}; got {pick_rule!r}; "
                "choose one of them"
            )
        check_range("reward_scale", reward_scale, 1e-6, 1e6)
        self.pick_rule: PickRule = pick_rule
        self._pick_points, n_pick_points = PICK_RULES[pick_rule]
        self._reward_scale = reward_scale
        n_actions = n_pick_points * len(DROP_POINTS_M)
        super().__init__("handkerchief", n_actions, options or ClothTaskOptions())

    def _plan(self, action: int) -> PlannedAction:
        pick, drop = divmod(action, len(DROP_POINTS_M))
        scene = self._scene
        pick_px = self._pick_points(scene.picture)[pick]
        return planned_pick_and_drop(
            scene.vertices_in_world(), scene.look.camera, pick_px, DROP_POINTS_M[drop]
        )

    def _judge(self) -> tuple[float, dict[str, Any]]:
        red_px = int(red_mask(self._scene.picture).sum())
        red_over_flat = red_px / self._flat_px
        reward = self._reward_scale * red_px / self.options.observation_px**2
        return reward, {
            "success": red_over_flat >= SUCCESS_PORTION,
            "red_over_flat": red_over_flat,
        }
