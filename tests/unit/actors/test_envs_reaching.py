import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st

import actors.envs
from actors.envs import ReachingEnv, make_env
from actors.envs.planar_arm import (
    INCREMENTS_RAD,
    TARGET_M,
    apply_action,
    end_effector_m,
    joint_positions_m,
    reaching_reward,
)
from actors.envs.reaching_picture import draw_arm

REPOSITORY = Path(actors.envs.__file__).resolve().parents[2]


def test_all_angles_zero_is_upright() -> None:
    np.testing.assert_allclose(end_effector_m(np.zeros(5)), [0.0, 1.0], atol=1e-12)


def test_the_stated_optimum_of_two_joints_is_at_the_target() -> None:
    optimum = end_effector_m(np.deg2rad([43.07, 93.86]))
    np.testing.assert_allclose(optimum, TARGET_M, atol=1e-3)
    grid_rad = np.deg2rad(np.stack(np.meshgrid(np.arange(0, 180), np.arange(0, 180)), axis=-1))
    rewards = reaching_reward(end_effector_m(grid_rad))
    row, column = np.unravel_index(rewards.argmax(), rewards.shape)
    assert (abs(int(column) - 43), abs(int(row) - 94)) <= (1, 1)


@given(st.lists(st.floats(-3, 3), min_size=1, max_size=50))
def test_limbs_have_equal_lengths_that_sum_to_one(angles_rad: list[float]) -> None:
    joints_m = joint_positions_m(np.array(angles_rad))
    limbs_m = np.linalg.norm(np.diff(joints_m, axis=0), axis=1)
    np.testing.assert_allclose(limbs_m, 1 / len(angles_rad))
    np.testing.assert_allclose(joints_m[-1], end_effector_m(np.array(angles_rad)), atol=1e-12)


def test_each_action_moves_one_joint_by_one_increment() -> None:
    moved = [apply_action(np.zeros(3), action) for action in range(15)]
    np.testing.assert_allclose(
        moved, np.kron(np.eye(3), np.array(INCREMENTS_RAD)[:, None]), atol=1e-12
    )


def test_doing_nothing_returns_what_the_start_is_worth() -> None:
    env = ReachingEnv()
    env.reset()
    rewards = [env.step(2)[1] for _ in range(30)]
    assert sum(rewards) == pytest.approx(-30 * 1.683)


def test_the_horizon_truncates_and_never_terminates() -> None:
    env = ReachingEnv(horizon=3)
    env.reset()
    ends = [env.step(0)[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    with pytest.raises(RuntimeError, match=r"got none, or one that is over; call reset\(\)"):
        env.step(0)


def test_success_is_a_short_distance() -> None:
    env = ReachingEnv(n_joints=2, horizon=40)
    _, info = env.reset()
    assert info["success"] is False
    assert info["guard"] is None
    for action in [4] * 9 + [9] * 19:
        _, _, _, _, info = env.step(action)
    assert info["distance_m"] < 0.1
    assert info["success"] is True
    np.testing.assert_allclose(info["joint_angles_rad"], [9 * 0.0875, 19 * 0.0875])


@pytest.mark.parametrize(("colour", "channels"), [("grayscale", 1), ("rgb", 3)])
@pytest.mark.parametrize("n_joints", [1, 2, 50])
def test_gymnasium_s_checker_passes(colour: str, channels: int, n_joints: int) -> None:
    env = make_env(
        "clothbus/Reaching-v0", n_joints=n_joints, colour=colour, render_mode="rgb_array"
    )
    check_env(env)
    assert env.observation_space.shape == (84, 84, channels)
    assert env.action_space.n == 5 * n_joints  # type: ignore[attr-defined]


@pytest.mark.parametrize("colour", ["grayscale", "rgb"])
def test_every_state_looks_different(colour: str) -> None:
    env = ReachingEnv(n_joints=5, colour=colour)  # type: ignore[arg-type]
    pictures = set()
    for action in range(25):
        env.reset()
        pictures.add(env.step(action)[0].tobytes())
    assert len(pictures) == 21  # five of the actions move nothing


def test_the_picture_is_upright_and_not_mirrored() -> None:
    upright = draw_arm(joint_positions_m(np.zeros(1)), 84, "rgb")
    effector = np.argwhere((upright == (255, 210, 0)).all(axis=2)).mean(axis=0)
    np.testing.assert_allclose(effector, [41.5 - 40, 41.5], atol=0.6)
    target = np.argwhere((upright == (230, 40, 40)).all(axis=2)).mean(axis=0)
    np.testing.assert_allclose(target, [41.5, 41.5 + 0.683 * 40], atol=0.6)


def test_the_whole_reach_is_in_the_picture() -> None:
    effector_px = [
        (draw_arm(joint_positions_m(np.array([turn_rad])), 84, "rgb") == (255, 210, 0))
        .all(axis=2)
        .sum()
        for turn_rad in np.deg2rad([-135, -90, -45, 0, 45, 135, 180])
    ]
    assert min(effector_px) > 0.7 * max(effector_px)


def test_the_same_picture_in_another_process() -> None:
    program = (
        "import hashlib; from actors.envs import ReachingEnv; env = ReachingEnv(50, 'rgb');"
        "env.reset(); pictures = [env.step(a)[0].tobytes() for a in range(4, 150, 7)];"
        "print(hashlib.sha256(b''.join(pictures)).hexdigest())"
    )
    command = [sys.executable, "-c", program]
    digests = {
        subprocess.run(command, cwd=REPOSITORY, capture_output=True, check=True).stdout
        for _ in range(2)
    }
    assert len(digests) == 1


@pytest.mark.parametrize("action", [-1, 25, 0.5, "up", None, True])
def test_an_action_out_of_range_is_refused(action: object) -> None:
    env = ReachingEnv()
    env.reset()
    with pytest.raises(ValueError, match="action: expected an integer from 0 to 24; got"):
        env.step(action)  # type: ignore[arg-type]


def test_a_numpy_action_is_an_action() -> None:
    env = ReachingEnv()
    env.reset()
    assert env.step(np.int64(24))[0].shape == (84, 84, 1)


@pytest.mark.parametrize(
    "argument",
    [
        {"n_joints": 0},
        {"n_joints": 2.5},
        {"colour": "blue"},
        {"horizon": 0},
        {"horizon": True},
        {"render_px": 10},
        {"render_mode": "human"},
    ],
)
def test_arguments_out_of_the_rule_are_refused(argument: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=rf"{next(iter(argument))}: expected .*; got "):
        ReachingEnv(**argument)  # type: ignore[arg-type]


def test_render_gives_a_large_picture_only_when_asked() -> None:
    env = ReachingEnv(render_mode="rgb_array", render_px=200)
    env.reset()
    picture = env.render()
    assert picture is not None
    assert picture.shape == (200, 200, 3)
    assert ReachingEnv().render() is None
