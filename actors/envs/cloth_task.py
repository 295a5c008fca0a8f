"""What all cloth tasks have in common: how an episode begins, goes on and breaks off."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, SupportsIndex

import gymnasium
import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.engine import ClothEngineError
from actors.cloth.engines import Settings, make_engine, with_material
from actors.cloth.garments import (
    Garment,
    GarmentKind,
    garment_from_obj,
    make_garment,
    usual_spacing_m,
)
from actors.cloth.gestures import Gesture, pick_and_drop
from actors.cloth.grasps import grasped_vertices
from actors.cloth.guard import GuardReason
from actors.cloth.masks import cloth_mask
from actors.cloth.rasteriser import HANDKERCHIEF_COLOURS, ClothColours, Paint
from actors.envs.arguments import checked_action
from actors.envs.cloth_options import ClothTaskOptions
from actors.envs.episode_clock import EpisodeClock
from actors.envs.initial_states import (
    CREASES,
    RANDOM_ACTIONS,
    InitialState,
    Pose,
    check_initial_state,
    crease,
    fold_over,
    initial_pose,
)
from actors.envs.randomisation import Conditions, make_randomisation
from actors.envs.scene import Look, Scene
from actors.envs.stored_states import StoredStart, stored_states_of
from actors.robot.planning import STEP_M, Obstacle
from actors.robot.reach import Reach

MOST_START_ATTEMPTS: Final = 5


@dataclass(frozen=True)
class PlannedAction:
    """What an action means for the cloth as it lies now."""

    gesture: Gesture
    info: dict[str, Any] = field(default_factory=dict)
    """Where hands pick and drop, for `info`: pixels and metres."""


def planned_pick_and_drop(
    vertices_in_world: NDArray[np.float64],
    camera: Camera,
    pick_px: NDArray[np.int64],
    drop_xy_m: tuple[float, float],
) -> PlannedAction:
    """Pick cloth that lies so, f64[V, 3], up at a pixel i64[2] (column, row) and drop it."""
    column, row = pick_px.tolist()
    pick_xy_m = camera.table_point_m((column + 0.5, row + 0.5))
    grasped = grasped_vertices(vertices_in_world, pick_xy_m)
    return PlannedAction(
        pick_and_drop(vertices_in_world, grasped, drop_xy_m),
        {"pick_px": (column, row), "drop_xy_m": drop_xy_m},
    )


class ClothTaskEnv(gymnasium.Env[NDArray[np.uint8], SupportsIndex], ABC):
    """A task with one garment. Observation: u8[84, 84, 3].

    A step after which the cloth cannot be right (see `actors.cloth.guard`) truncates the episode:
    the reward is 0, the observation is the one before the step, and `info["guard"]` holds the
    reason. Such a transition must not be learned from. An episode is truncated at the horizon.

    `info` holds `success`, `guard` (None or a reason), the task's measures and, after a step, what
    the action was. With `robot` it also holds `action_mask` (i8[n_actions], 1 where the arms can do
    it, as `action_space.sample` wants it) and, after a step, `unreachable` (None or an
    `actors.robot.planning.Obstacle`): then the cloth was left as it is. With `stored_states` a
    reset's holds `initial_state` and `stored_index`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012
    action_space: gymnasium.spaces.Discrete

    def __init__(
        self,
        kind: GarmentKind,
        n_actions: int,
        options: ClothTaskOptions,
        colours: ClothColours = HANDKERCHIEF_COLOURS,
        usual_settings: Mapping[str, Settings] | None = None,
    ) -> None:
        """Make the task; a simulator starts with the first reset.

        Args:
            kind: of garment, unless the options name a file.
            n_actions: of the task.
            options: what was chosen.
            colours: of the garment and of the table.
            usual_settings: by engine, where the task's cloth differs from the engine's.

        Raises:
            ValueError: an option is out of the rule, or stored states are not of the garment.
            OSError: the garment's file cannot be read.
        """
        self.options = options
        self.render_mode = options.render_mode
        self._kind: GarmentKind = kind
        self._colours = colours
        self._randomisation = make_randomisation(options.randomisation)
        self._camera = Camera(options.observation_px, options.view_half_width_m)
        self._render_camera = replace(self._camera, size_px=options.render_px)
        self._clock = EpisodeClock(options.horizon)
        usual = (usual_settings or {}).get(options.engine, {})
        self._engine_settings = {**usual, **(options.engine_settings or {})}
        self._scene = Scene(make_engine(options.engine, self._engine_settings))
        self._usual_garment = self._make_garment()
        source = options.stored_states
        self._stored = None if source is None else stored_states_of(source, self._usual_garment)
        self._conditions = Conditions()
        self._flat_px = 0
        self._reach: Reach | None = None
        shape = (options.observation_px, options.observation_px, 3)
        self.observation_space = gymnasium.spaces.Box(0, 255, shape, np.uint8)
        self.action_space = gymnasium.spaces.Discrete(n_actions)

    @abstractmethod
    def _plan(self, action: int) -> PlannedAction:
        """What to do with the cloth as the last picture shows it."""

    @abstractmethod
    def _judge(self) -> tuple[float, dict[str, Any]]:
        """Reward and measures of the cloth as it lies now; `success` is among the measures."""

    def _begin(self) -> None:
        """Called when a garment was laid and before anything is judged: a task's own memory."""

    def _paint(self, garment: Garment, colours: ClothColours) -> Paint | None:
        """Prints and markers; None where either side has one colour."""
        del garment, colours
        return None

    @property
    def n_actions(self) -> int:
        """How many actions there are."""
        return int(self.action_space.n)

    @property
    def camera(self) -> Camera:
        """The one that takes the observations of this episode."""
        return self._conditions.moved(self._camera)

    @property
    def flat_px(self) -> int:
        """How many pixels of an observation the garment covers when it is spread out.

        Raises:
            ClothEngineError: before the first reset.
        """
        _ = self._scene.garment
        return self._flat_px

    @property
    def garment(self) -> Garment:
        """What lies on the table.

        Raises:
            ClothEngineError: before the first reset.
        """
        return self._scene.garment

    @property
    def steps_done(self) -> int:
        """Steps made in this episode."""
        return self._clock.steps_done

    def vertices_in_world(self) -> NDArray[np.float64]:
        """Where the garment's vertices are, f64[V, 3], metres: for measures, never for learning.

        After a step that the guard stopped, where they were before it.
        """
        return self._scene.vertices_in_world()

    def planned(self, action: int) -> PlannedAction:
        """What an action would mean for the cloth as the last picture shows it."""
        return self._plan(checked_action(action, self.n_actions))

    def picture_of(self, vertices_in_world: NDArray[np.float64]) -> NDArray[np.uint8]:
        """The observation without noise if the garment lay so, f64[V, 3], metres."""
        return self._scene.look.picture(vertices_in_world, self._scene.garment)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Lay a garment on the table in its initial state.

        Args:
            seed: draws everything that is random, from now on.
            options: `initial_state`, for this episode instead of the one that was chosen, and
                `stored_index`, the stored state to begin with instead of one that is drawn.

        Raises:
            ValueError: there is no such initial state.
            ClothEngineError: the simulator does not start, or broke the cloth in each of 5
                attempts.
        """
        super().reset(seed=seed, options=options)
        given = options or {}
        name = given.get("initial_state", self.options.initial_state)
        check_initial_state(name)
        stored = self._stored_start(name, given.get("stored_index"))
        for _ in range(MOST_START_ATTEMPTS):
            reason = self._try_start(name, stored)
            if reason is None:
                self._clock.start()
                _, measures = self._judge()
                info = measures | {"guard": None} | self._mask()
                info |= stored.reset_options if stored else {}
                return self._scene.picture.copy(), info
        raise ClothEngineError(
            f"reset(): expected a sound cloth within {MOST_START_ATTEMPTS} attempts; got "
            f"{reason}; give the engine a shorter time step or the cloth fewer vertices"
        )

    def step(
        self, action: SupportsIndex
    ) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Do something to the cloth.

        Raises:
            RuntimeError: no episode is running.
            ValueError: there is no such action.
        """
        self._clock.check_running()
        index = checked_action(action, self.n_actions)
        planned = self._plan(index)
        unreachable = self._obstacle(planned.gesture)
        reason = self._perform(planned.gesture) if unreachable is None else None
        truncated = self._clock.tick()
        reward, measures = self._judge()
        if reason is not None:
            self._clock.stop()
            truncated, reward = True, 0.0
            measures |= {"success": False}
        info = measures | planned.info | {"guard": None if reason is None else reason.value}
        if self.options.robot:
            info |= {"unreachable": None if unreachable is None else unreachable.value}
            info |= self._mask() if reason is None else {}
        return self._scene.picture.copy(), reward, False, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """The scene, u8[render_px, render_px, 3]; None without a render mode.

        Raises:
            ClothEngineError: before the first reset, or after a step that lost the simulator.
        """
        if self.render_mode is None:
            return None
        return self._scene.drawn(self._conditions.moved(self._render_camera))

    def close(self) -> None:
        """End the simulator; may be called twice."""
        self._clock.stop()
        self._scene.close()
        if self._reach is not None:
            self._reach.close()
            self._reach = None

    def _arms(self) -> Reach:
        if self._reach is None:
            self._reach = Reach()
        return self._reach

    def _obstacle(self, gesture: Gesture) -> Obstacle | None:
        """Why the robot cannot make a gesture; None where it can, or there is no robot."""
        if not self.options.robot:
            return None
        return self._arms().obstacle(self._scene.vertices_in_world(), gesture, STEP_M)

    def _mask(self) -> dict[str, Any]:
        """Which actions the robot can make, for `info`."""
        if not self.options.robot:
            return {}
        vertices = self._scene.vertices_in_world()
        gestures = [self._plan(action).gesture for action in range(self.n_actions)]
        reachable = [self._arms().obstacle(vertices, it, np.inf) is None for it in gestures]
        return {"action_mask": np.array(reachable, dtype=np.int8)}

    def _stored_start(self, name: InitialState, index: int | None) -> StoredStart | None:
        if self._stored is not None:
            return self._stored.start(name, index, self.np_random)
        if index is not None:
            raise ValueError(
                f"stored_index: expected none without stored states; got {index}; choose some by "
                "the option stored_states"
            )
        return None

    def _try_start(self, name: InitialState, stored: StoredStart | None) -> GuardReason | None:
        random = self.np_random
        self._conditions = self._randomisation.draw(random)
        size = self._conditions.size
        garment = self._usual_garment if size == 1.0 else self._make_garment(size)
        colours = self._conditions.recoloured(self._colours)
        look = Look(
            self.camera,
            colours,
            self._paint(garment, colours),
            self._conditions.light,
            self._randomisation.noise,
        )
        self._flat_px = int(cloth_mask(look.picture(garment.mesh.vertices_m, garment)).sum())
        self._use_material()
        if stored is None:
            vertices = self._start_pose(name).placed(garment.mesh.vertices_m)
            reason = self._scene.lay(garment, vertices, look, random)
        else:
            reason = self._scene.lay(garment, stored.vertices_m, look, random, came_to_rest=True)
        if reason is not None:
            return reason
        self._begin()
        return self._disturb(name) if stored is None else None

    def _start_pose(self, name: InitialState) -> Pose:
        pose = initial_pose(name, self.np_random)
        shift = self.np_random.uniform(-1.0, 1.0, 2) * self.options.start_shift_m
        turn = self.np_random.uniform(-1.0, 1.0) * self.options.start_turn_rad
        conditions = self._conditions
        return Pose(
            pose.turn_rad + turn + conditions.turn_rad,
            pose.x_m + shift[0] + conditions.shift_m[0],
            pose.y_m + shift[1] + conditions.shift_m[1],
        )

    def _disturb(self, name: InitialState) -> GuardReason | None:
        """What is done to the spread garment before the first observation."""
        creases = self._conditions.creases + (CREASES if name == "creased" else 0)
        makers = [crease] * creases + [fold_over] * (name == "folded_over")
        for make in makers:
            camera = self._scene.look.camera
            gesture = make(
                self._scene.vertices_in_world(), self._scene.mask, camera, self.np_random
            )
            if reason := self._scene.perform(gesture):
                return reason
        for _ in range(RANDOM_ACTIONS if name == "random" else 0):
            action = int(self.np_random.integers(self.n_actions))
            if reason := self._scene.perform(self._plan(action).gesture):
                return reason
        return None

    def _perform(self, gesture: Gesture) -> GuardReason | None:
        missed = self._randomisation.missed_grasps
        if missed > 0.0 and self.np_random.random() < missed:
            return None  # the gripper closed on nothing
        return self._scene.perform(gesture)

    def _use_material(self) -> None:
        conditions, engine = self._conditions, self.options.engine
        if self._randomisation.stiffness == self._randomisation.friction == 0.0:
            return
        settings = with_material(
            engine,
            self._engine_settings,
            stiffness=conditions.stiffness,
            friction=conditions.friction,
        )
        self._scene.close()
        self._scene = Scene(make_engine(engine, settings))

    def _make_garment(self, scale: float = 1.0) -> Garment:
        options = self.options
        if options.obj_path is not None:
            metres_per_unit = options.metres_per_unit * scale
            return garment_from_obj(Path(options.obj_path), metres_per_unit=metres_per_unit)
        spacing_m = options.spacing_m
        if spacing_m is None:
            spacing_m = usual_spacing_m(self._kind, options.engine)
        return make_garment(self._kind, sizes=options.sizes, spacing_m=spacing_m, scale=scale)
