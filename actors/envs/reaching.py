"""Reaching with a planar arm of n joints, seen in a picture."""

from typing import Any, SupportsIndex

import gymnasium
import numpy as np
from numpy.typing import NDArray

from actors.envs.arguments import check_render_mode, check_size, checked_action
from actors.envs.episode_clock import EpisodeClock
from actors.envs.planar_arm import (
    INCREMENTS_RAD,
    SUCCESS_DISTANCE_M,
    apply_action,
    distance_m,
    end_effector_m,
    joint_positions_m,
    reaching_reward,
)
from actors.envs.reaching_picture import Colour, draw_arm

OBSERVATION_PX = 84


def observe_arm(joint_angles_rad: NDArray[np.float64], colour: Colour) -> NDArray[np.uint8]:
    """What an arm with these angles, f64[n], looks like to its policy, u8[84, 84, 1 or 3]."""
    return draw_arm(joint_positions_m(joint_angles_rad), OBSERVATION_PX, colour)


class ReachingEnv(gymnasium.Env[NDArray[np.uint8], SupportsIndex]):
    """The n-DOF reaching task, `clothbus/Reaching-v0`.

    Observation: u8[84, 84, 1] or u8[84, 84, 3], the drawn arm. Action: joint * 5 + index into the
    five increments. Reward: -(abs(X - 0.6830) + abs(Y)) after the action. Every episode begins with
    the arm upright and is truncated at the horizon. Nothing is random.

    `info`: `success` (the end effector is nearer than 0.1 to the target), `guard` (always None),
    `distance_m`, `joint_angles_rad` (f64[n]).

    Source: tables 3.1a and 4.1a. **assumed**: upright at all angles 0 (the stated optimum implies
    it), and how the arm is drawn.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012
    action_space: gymnasium.spaces.Discrete

    def __init__(
        self,
        n_joints: int = 5,
        colour: Colour = "grayscale",
        horizon: int = 30,
        render_px: int = 336,
        render_mode: str | None = None,
    ) -> None:
        """Make the task.

        Args:
            n_joints: joints of the arm, at least 1; each limb has length 1 / n_joints.
            colour: "grayscale" (chapter 3) or "rgb" (chapter 4).
            horizon: steps in an episode.
            render_px: width and height of what `render` returns.
            render_mode: None or "rgb_array".

        Raises:
            ValueError: an argument is out of the rule.
        """
        check_size("n_joints", n_joints, least=1)
        check_size("render_px", render_px, least=OBSERVATION_PX)
        check_render_mode(render_mode)
        if colour not in ("grayscale", "rgb"):
            raise ValueError(
                f"colour: expected 'grayscale' or 'rgb'; got {colour!r}; choose one of them"
            )
        self.n_joints = n_joints
        self.render_mode = render_mode
        self._colour: Colour = colour
        self._render_px = render_px
        self._clock = EpisodeClock(horizon)
        self._joint_angles_rad = np.zeros(n_joints)
        channels = 1 if colour == "grayscale" else 3
        self.observation_space = gymnasium.spaces.Box(
            0, 255, (OBSERVATION_PX, OBSERVATION_PX, channels), np.uint8
        )
        self.action_space = gymnasium.spaces.Discrete(n_joints * len(INCREMENTS_RAD))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Put the arm upright; the seed and the options change nothing."""
        super().reset(seed=seed, options=options)
        self._joint_angles_rad = np.zeros(self.n_joints)
        self._clock.start()
        return self._observation(), self._info()

    def step(
        self, action: SupportsIndex
    ) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Turn one joint by one increment.

        Raises:
            RuntimeError: no episode is running.
            ValueError: there is no such action.
        """
        self._clock.check_running()
        index = checked_action(action, self.n_joints * len(INCREMENTS_RAD))
        self._joint_angles_rad = apply_action(self._joint_angles_rad, index)
        reward = float(reaching_reward(end_effector_m(self._joint_angles_rad)))
        return self._observation(), reward, False, self._clock.tick(), self._info()

    @property
    def joint_angles_rad(self) -> NDArray[np.float64]:
        """Of each joint relative to the limb before it, f64[n]: what a scripted expert may see."""
        return self._joint_angles_rad.copy()

    def render(self) -> NDArray[np.uint8] | None:
        """The picture in colour, u8[render_px, render_px, 3]; None without a render mode."""
        if self.render_mode is None:
            return None
        return draw_arm(joint_positions_m(self._joint_angles_rad), self._render_px, "rgb")

    def _observation(self) -> NDArray[np.uint8]:
        return observe_arm(self._joint_angles_rad, self._colour)

    def _info(self) -> dict[str, Any]:
        to_target_m = distance_m(end_effector_m(self._joint_angles_rad))
        return {
            "success": to_target_m < SUCCESS_DISTANCE_M,
            "guard": None,
            "distance_m": to_target_m,
            "joint_angles_rad": self._joint_angles_rad.copy(),
        }
