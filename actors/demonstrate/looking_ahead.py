"""A demonstrator that tries actions on a model of the cloth before it chooses one.

Flipping a cloth by single hands is too rich for a rule over pictures: the same picture lies over
many foldings. So this expert knows what a learner does not: where the cloth's vertices are, and an
XPBD cloth to try every action on. On that engine it foresees exactly, on another about.
"""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from actors.cloth.guard import guard
from actors.cloth.masks import red_mask
from actors.cloth.xpbd_engine import XpbdEngine, XpbdState
from actors.cloth.xpbd_settings import XpbdSettings
from actors.envs.handkerchief import DROP_POINTS_M, HandkerchiefFlipEnv

GOOD_ENOUGH: Final = 0.95
"""Red over the flat cloth's area after which no better action is looked for."""

KEEPS: Final = 0.9
"""Foreseen so red, a flipped cloth is left nearly as it lies."""


def _model(task: HandkerchiefFlipEnv) -> XpbdEngine:
    is_its_own = task.options.engine == "xpbd"
    settings: dict[str, Any] = dict(task.options.engine_settings or {}) if is_its_own else {}
    return XpbdEngine(XpbdSettings(**settings))


@dataclass(eq=False)
class FlipExpert:
    """Flips a handkerchief by looking one action ahead.

    A flipped cloth is left nearly as it lies: the expert then picks the point nearest to a drop
    point, if that is foreseen to keep it flipped. Otherwise it tries every action, in order, until
    one makes the cloth red enough, and takes that or the one that makes it reddest; of equals the
    first.
    """

    task: HandkerchiefFlipEnv
    """The environment in which it acts; a gesture for the robot is tried without the robot."""

    _engine: XpbdEngine = field(init=False)

    def __post_init__(self) -> None:
        """Make the model."""
        self._engine = _model(self.task)

    def action(self) -> int:
        """The next action for the cloth as it lies now: pick point * 6 + drop point."""
        gentlest = self._gentlest()
        if self._is_flipped() and self.foreseen(gentlest) >= KEEPS:
            return gentlest
        best, reddest = gentlest, -1.0
        for action in range(self.task.n_actions):
            red = self.foreseen(action)
            if red > reddest:
                best, reddest = action, red
            if red >= GOOD_ENOUGH:
                break
        return best

    def foreseen(self, action: int) -> float:
        """Red over the flat cloth's area after an action; -1 where the cloth would break."""
        task, engine = self.task, self._engine
        mesh, vertices = task.garment.mesh, task.vertices_in_world()
        engine.restore(XpbdState(mesh, vertices, np.zeros_like(vertices)))
        engine.perform(task.planned(action).gesture)
        after = engine.vertices_in_world()
        if guard(mesh, after) is not None:
            return -1.0
        return float(red_mask(task.picture_of(after)).sum()) / task.flat_px

    def _is_flipped(self) -> bool:
        red_px = red_mask(self.task.picture_of(self.task.vertices_in_world())).sum()
        return bool(red_px >= KEEPS * self.task.flat_px)

    def _gentlest(self) -> int:
        """The action that carries the cloth least far."""
        drops_m = np.array(DROP_POINTS_M)
        picks_m = self.task.camera.table_points_m(self._picks_px() + 0.5)
        carry_m = np.linalg.norm(picks_m[:, None] - drops_m[None], axis=2)
        return int(carry_m.argmin())  # row by row: pick point * 6 + drop point

    def _picks_px(self) -> NDArray[np.float64]:
        picks = range(0, self.task.n_actions, len(DROP_POINTS_M))
        return np.array([self.task.planned(pick).info["pick_px"] for pick in picks], np.float64)
