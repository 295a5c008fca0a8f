"""Flipping a handkerchief by picking it up and dropping it, seen in a picture."""

from dataclasses import dataclass
from typing import Any, Final, Literal, SupportsIndex

import gymnasium
import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.engine import ClothEngineError
from actors.cloth.engines import Settings, make_engine
from actors.cloth.gripper import grasped_vertices
from actors.cloth.guard import GuardReason, guard
from actors.cloth.masks import cloth_mask, red_mask
from actors.cloth.meshes import rectangular_sheet
from actors.cloth.pick_points import PickPoints, contour_pick_points, grid_pick_points
from actors.cloth.rasteriser import draw_cloth
from actors.envs.arguments import check_range, check_render_mode, check_size, checked_action
from actors.envs.episode_clock import EpisodeClock

DROP_POINTS_M: Final = tuple((x_m, y_m) for y_m in (0.09, -0.09) for x_m in (-0.12, 0.0, 0.12))
"""2 x 3 points of the table, from the picture's top left, row by row. **assumed**"""

SUCCESS_PORTION: Final = 0.8
"""Least red area over the flat cloth's area. Source: chapter 4.3.1."""

OBSERVATION_PX: Final = 84
MOST_START_ATTEMPTS: Final = 5

PickRule = Literal["grid", "contour"]
PICK_RULES: Final[dict[PickRule, tuple[PickPoints, int]]] = {
    "grid": (grid_pick_points, 6),
    "contour": (contour_pick_points, 10),
}
"""Each rule's function and its number of points. Sources: chapters 3.3.1 and 4.3.1."""


@dataclass(frozen=True)
class _Scene:
    """What the camera last saw of a cloth that was in order."""

    picture: NDArray[np.uint8]
    red_px: int


class HandkerchiefFlipEnv(gymnasium.Env[NDArray[np.uint8], SupportsIndex]):
    """Handkerchief flipping: `clothbus/HandkerchiefFlip36-v0` and `clothbus/HandkerchiefFlip60-v0`.

    Observation: u8[84, 84, 3]. Action: pick point * 6 + drop point; the pick points are found in
    the observation before, the drop points are fixed on the table. Reward: red pixels over all
    pixels, times `reward_scale`. The cloth lies green side up at first; an episode is truncated at
    the horizon.

    A step after which the cloth cannot be right (see `actors.cloth.guard`) truncates the episode:
    the reward is 0, the observation is the one before the step, and `info["guard"]` holds the
    reason. Such a transition must not be learned from.

    `info`: `success` (red area at least 0.8 of the flat cloth's), `guard` (None or a reason),
    `red_over_flat` (that portion), and after a step `pick_px` (column, row) and `drop_xy_m`.

    Source: tables 3.2a and 4.2a. **assumed**: sizes, stiffness and the camera's view, which make
    the difficulty and are arguments.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012
    action_space: gymnasium.spaces.Discrete

    def __init__(
        self,
        pick_rule: PickRule,
        *,
        horizon: int = 30,
        engine: str = "pybullet",
        engine_settings: Settings | None = None,
        random_actions_at_start: int = 0,
        reward_scale: float = 1.0,
        cloth_size_m: float = 0.3,
        vertices_per_side: int = 12,
        view_half_width_m: float = 0.26,
        start_shift_m: float = 0.0,
        start_turn_rad: float = 0.0,
        render_px: int = 336,
        render_mode: str | None = None,
    ) -> None:
        """Make the task; the simulator starts with the first reset.

        Args:
            pick_rule: "grid", 6 points over the cloth's area, or "contour", 10 along and inside
                of its outline.
            horizon: steps in an episode.
            engine: a name of `actors.cloth.engines`.
            engine_settings: the engine's own numbers where they differ from its defaults, such as
                the bending stiffness.
            random_actions_at_start: actions made before the first observation.
            reward_scale: what the red portion of the picture is multiplied with.
            cloth_size_m: length of the cloth's side.
            vertices_per_side: how finely the cloth is simulated.
            view_half_width_m: half the width of the table that the picture shows.
            start_shift_m: the cloth begins at most this far from the middle, along x and along y.
            start_turn_rad: the cloth begins turned by at most this, either way.
            render_px: width and height of what `render` returns.
            render_mode: None or "rgb_array".

        Raises:
            ValueError: an argument is out of the rule.
        """
        if pick_rule not in PICK_RULES:
            raise ValueError(
                f"pick_rule: expected {' or '.join(map(repr, PICK_RULES))}; got {pick_rule!r}; "
                "choose one of them"
            )
        check_size("random_actions_at_start", random_actions_at_start, least=0)
        check_size("render_px", render_px, least=OBSERVATION_PX)
        check_range("reward_scale", reward_scale, 1e-6, 1e6)
        check_range("cloth_size_m", cloth_size_m, 0.05, 0.5)
        check_range("start_shift_m", start_shift_m, 0.0, 0.1)
        check_range("start_turn_rad", start_turn_rad, 0.0, np.pi)
        check_render_mode(render_mode)
        self.render_mode = render_mode
        self.pick_rule: PickRule = pick_rule
        self.cloth_size_m = cloth_size_m
        self.view_half_width_m = view_half_width_m
        self._pick_points, n_pick_points = PICK_RULES[pick_rule]
        self._n_actions = n_pick_points * len(DROP_POINTS_M)
        self._clock = EpisodeClock(horizon)
        self._engine = make_engine(engine, engine_settings)
        self._random_actions_at_start = random_actions_at_start
        self._reward_scale = reward_scale
        self._start_shift_m, self._start_turn_rad = start_shift_m, start_turn_rad
        self._mesh = rectangular_sheet(vertices_per_side, cloth_size_m)
        self._camera = Camera(OBSERVATION_PX, view_half_width_m)
        self._render_camera = Camera(render_px, view_half_width_m)
        flat = draw_cloth(self._mesh.vertices_m, self._mesh.faces, self._camera)
        self._flat_px = int(cloth_mask(flat).sum())
        self._scene = _Scene(flat, red_px=0)
        self.observation_space = gymnasium.spaces.Box(0, 255, flat.shape, np.uint8)
        self.action_space = gymnasium.spaces.Discrete(self._n_actions)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Lay a new handkerchief green side up and make the random actions, if any.

        The options change nothing.

        Raises:
            ClothEngineError: the simulator does not start, or broke the cloth in each of 5
                attempts.
        """
        super().reset(seed=seed, options=options)
        for _ in range(MOST_START_ATTEMPTS):
            reason = self._try_start()
            if reason is None:
                self._clock.start()
                return self._scene.picture.copy(), self._info(None)
        raise ClothEngineError(
            f"reset(): expected a sound cloth within {MOST_START_ATTEMPTS} attempts; got "
            f"{reason}; give the engine a shorter time step or the cloth fewer vertices"
        )

    def step(
        self, action: SupportsIndex
    ) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Pick the handkerchief up and drop it.

        Raises:
            RuntimeError: no episode is running.
            ValueError: there is no such action.
        """
        self._clock.check_running()
        index = checked_action(action, self._n_actions)
        pick_px, drop_xy_m = self._points_of(index)
        reason = self._pick_and_drop(pick_px, drop_xy_m)
        truncated = self._clock.tick()
        reward = self._reward_scale * self._scene.red_px / OBSERVATION_PX**2
        if reason is not None:
            self._clock.stop()
            truncated, reward = True, 0.0
        info = self._info(reason) | {"pick_px": pick_px, "drop_xy_m": drop_xy_m}
        return self._scene.picture.copy(), reward, False, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """The camera's picture, u8[render_px, render_px, 3]; None without a render mode.

        Raises:
            ClothEngineError: before the first reset, or after a step that lost the simulator.
        """
        if self.render_mode is None:
            return None
        vertices = self._engine.vertices_in_world()
        return draw_cloth(vertices, self._mesh.faces, self._render_camera)

    def close(self) -> None:
        """End the simulator; may be called twice."""
        self._clock.stop()
        self._engine.close()

    def _try_start(self) -> GuardReason | None:
        self._engine.reset(self._mesh, self._start_vertices())
        reason = self._look()
        for _ in range(self._random_actions_at_start):
            if reason is None:
                action = int(self.np_random.integers(self._n_actions))
                reason = self._pick_and_drop(*self._points_of(action))
        return reason

    def _start_vertices(self) -> NDArray[np.float64]:
        turn_rad = self.np_random.uniform(-self._start_turn_rad, self._start_turn_rad)
        shift_m = self.np_random.uniform(-self._start_shift_m, self._start_shift_m, size=2)
        cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
        vertices = self._mesh.vertices_m.copy()
        vertices[:, :2] = vertices[:, :2] @ np.array([[cosine, sine], [-sine, cosine]]) + shift_m
        return vertices

    def _points_of(self, action: int) -> tuple[tuple[int, int], tuple[float, float]]:
        pick, drop = divmod(action, len(DROP_POINTS_M))
        column, row = self._pick_points(self._scene.picture)[pick].tolist()
        return (column, row), DROP_POINTS_M[drop]

    def _pick_and_drop(
        self, pick_px: tuple[int, int], drop_xy_m: tuple[float, float]
    ) -> GuardReason | None:
        pick_xy_m = self._camera.table_point_m((pick_px[0] + 0.5, pick_px[1] + 0.5))
        grasped = grasped_vertices(self._engine.vertices_in_world(), pick_xy_m)
        try:
            self._engine.pick_and_drop(grasped, drop_xy_m)
        except ClothEngineError:
            return GuardReason.ENGINE_LOST
        return self._look()

    def _look(self) -> GuardReason | None:
        """Take the new picture, unless the cloth is not in order: then keep the last one."""
        vertices = self._engine.vertices_in_world()
        reason = guard(self._mesh, vertices)
        if reason is not None:
            return reason
        picture = draw_cloth(vertices, self._mesh.faces, self._camera)
        if not cloth_mask(picture).any():
            return GuardReason.OUT_OF_VIEW
        self._scene = _Scene(picture, int(red_mask(picture).sum()))
        return None

    def _info(self, reason: GuardReason | None) -> dict[str, Any]:
        red_over_flat = self._scene.red_px / self._flat_px
        return {
            "success": reason is None and red_over_flat >= SUCCESS_PORTION,
            "guard": None if reason is None else reason.value,
            "red_over_flat": red_over_flat,
        }
