"""What all cloth tasks have in common: how an episode begins, goes on and breaks off."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
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
from actors.cloth.gestures import Gesture
from actors.cloth.guard import GuardReason
from actors.cloth.masks import cloth_mask
from actors.cloth.rasteriser import HANDKERCHIEF_COLOURS, ClothColours, Paint
from actors.cloth.spreading import OnPull, Spread, SpreadAim, SpreadEnd
from actors.envs.arguments import checked_action
from actors.envs.arms import Arms
from actors.envs.automatic_reset import (
    AIM,
    PLACED,
    SceneTable,
    check_automatic_reset,
    reset_info,
    spread_scene,
    spreading_camera,
)
from actors.envs.cloth_options import ClothTaskOptions
from actors.envs.disturbing import disturb
from actors.envs.episode_clock import EpisodeClock
from actors.envs.initial_states import (
    RANDOM_ACTIONS,
    InitialState,
    Pose,
    check_initial_state,
    initial_pose,
)
from actors.envs.planned_actions import PlannedAction
from actors.envs.randomisation import Conditions, make_randomisation
from actors.envs.scene import Look, Scene
from actors.envs.stored_states import StoredStart, stored_states_of
from actors.robot.planning import Obstacle
from actors.robot.stances import STANCES

MOST_START_ATTEMPTS: Final = 5


class ClothTaskEnv(gymnasium.Env[NDArray[np.uint8], SupportsIndex], ABC):
    """A task with one garment. Observation: u8[84, 84, 3].

    A step after which the cloth cannot be right (see `actors.cloth.guard`) truncates the episode:
    the reward is 0, the observation is the one before the step, and `info["guard"]` holds the
    reason. Such a transition must not be learned from. An episode is truncated at the horizon.

    `info` holds `success`, `guard` (None or a reason), the task's measures and, after a step, what
    the action was, also as `marks` in the picture. With `robot` it also holds `action_mask`
    (i8[n_actions], 1 where the arms can do it, as `action_space.sample` wants it) and, after a
    step, `unreachable` and `motion`: None and the `JointPath` of the arms, or an
    `actors.robot.planning.Obstacle` and None; then the cloth was left as it is, and there are no
    marks. With `stored_states` a reset's holds `initial_state` and `stored_index`.
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
        if options.automatic_reset:
            check_automatic_reset(kind)
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
        self.arms = Arms(STANCES[options.robot_stance]) if options.robot else None
        """The robot's; None without a robot."""

        self._scene = self._new_scene(self._engine_settings)
        self._usual_garment = self._make_garment()
        source = options.stored_states
        self._stored = None if source is None else stored_states_of(source, self._usual_garment)
        self._conditions = Conditions()
        self._flat_px = 0
        self._is_in_order = False
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
        if self.arms is not None:
            self.arms.draw_back()
        given = options or {}
        name = given.get("initial_state", self.options.initial_state)
        check_initial_state(name)
        stored = self._stored_start(name, given.get("stored_index"))
        outcome = self._try_spread(name)
        if outcome is not None and self._is_in_order:
            return self._start(outcome, by_hand=False)
        for _ in range(MOST_START_ATTEMPTS):
            reason = self._try_start(name, stored)
            if reason is None:
                observation, info = self._start(outcome, by_hand=True)
                return observation, info | (stored.reset_options if stored else {})
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
        unreachable, reason = self._attempt(planned.gesture)
        truncated = self._clock.tick()
        reward, measures = self._judge()
        if reason is not None:
            self._clock.stop()
            self._is_in_order = False
            truncated, reward = True, 0.0
            measures |= {"success": False}
        marks = planned.marks if unreachable is None else ()
        info = measures | planned.info | {"marks": marks}
        info |= {"guard": None if reason is None else reason.value}
        if self.arms is not None:
            info |= {"unreachable": None if unreachable is None else unreachable.value}
            info |= {"motion": self.arms.motion}
            info |= self._mask() if reason is None else {}
        return self._scene.picture.copy(), reward, False, truncated, info

    def spread(
        self,
        aim: SpreadAim | None = None,
        size_px: int | None = None,
        on_pull: OnPull | None = None,
    ) -> Spread:
        """Spread the garment by pick and drop, as its picture shows it, outside of any episode.

        Args:
            aim: when to stop.
            size_px: width of the pictures for it; by default the observation's, at least 84.
            on_pull: is told of each pull before it is made.

        Raises:
            ClothEngineError: before the first reset.
        """
        _ = self._scene.garment
        table = SceneTable(
            self._scene,
            spreading_camera(self.camera, size_px),
            self.np_random,
            self._attempt,
        )
        return spread_scene(table, aim, on_pull)

    def render(self) -> NDArray[np.uint8] | None:
        """The scene, u8[render_px, render_px, 3]; None without a render mode.

        Raises:
            ClothEngineError: before the first reset, or after a step that lost the simulator.
        """
        if self.render_mode is None:
            return None
        return self._scene.drawn(self._conditions.moved(self._render_camera))

    def robot_film(self) -> list[NDArray[np.uint8]]:
        """The robot in the last step, u8[render_px, render_px, 3] each; see `Arms.pictures`."""
        if self.arms is None:
            return []
        return self.arms.pictures(self._scene, self.options.render_px)

    def close(self) -> None:
        """End the simulator; may be called twice."""
        self._clock.stop()
        self._is_in_order = False
        self._scene.close()

    def _attempt(self, gesture: Gesture) -> tuple[Obstacle | None, GuardReason | None]:
        """Make a gesture if the arms can; why not, or why the cloth is not in order afterwards."""
        missed = self._randomisation.missed_grasps
        is_missed = missed > 0.0 and self.np_random.random() < missed
        if self.arms is not None:
            return self.arms.attempt(self._scene, gesture, is_missed=is_missed)
        return None, None if is_missed else self._scene.perform(gesture)

    def _mask(self) -> dict[str, Any]:
        """Which actions the robot can make, for `info`."""
        if self.arms is None:
            return {}
        gestures = (self._plan(action).gesture for action in range(self.n_actions))
        return {"action_mask": self.arms.look_ahead(self._scene, gestures)}

    def _new_scene(self, settings: Settings) -> Scene:
        stance = None if self.arms is None else self.arms.stance
        return Scene(make_engine(self.options.engine, settings, stance))

    def _start(
        self, outcome: Spread | None, *, by_hand: bool
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        self._is_in_order = True
        self._clock.start()
        _, measures = self._judge()
        info = measures | {"guard": None} | self._mask()
        if self.options.automatic_reset:
            info |= reset_info(outcome, by_hand)
        return self._scene.picture.copy(), info

    def _try_spread(self, name: InitialState) -> Spread | None:
        """Begin with the cloth that lies there; None where there is none, or it must be placed."""
        if not (self.options.automatic_reset and self._is_in_order) or name in PLACED:
            return None
        self._is_in_order = False
        outcome = self.spread(AIM)
        if outcome.end is SpreadEnd.SPREAD:
            self._begin()
            self._is_in_order = self._disturb(name) is None
        return outcome

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
        scene, random = self._scene, self.np_random
        reason = disturb(scene, name, self._conditions.creases, self._flat_px, random)
        for _ in range(RANDOM_ACTIONS if name == "random" and reason is None else 0):
            action = int(random.integers(self.n_actions))
            if reason := scene.perform(self._plan(action).gesture):
                return reason
        return reason

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
        self._scene = self._new_scene(settings)

    def _make_garment(self, scale: float = 1.0) -> Garment:
        options = self.options
        if options.obj_path is not None:
            metres_per_unit = options.metres_per_unit * scale
            return garment_from_obj(Path(options.obj_path), metres_per_unit=metres_per_unit)
        spacing_m = options.spacing_m
        if spacing_m is None:
            spacing_m = usual_spacing_m(self._kind, options.engine)
        return make_garment(self._kind, sizes=options.sizes, spacing_m=spacing_m, scale=scale)
