import os
import signal
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from actors.cloth.engine import ClothEngineError
from actors.cloth.masks import cloth_mask, red_mask
from actors.cloth.pybullet_process import PyBulletProcessEngine
from actors.envs import ClothTaskOptions, HandkerchiefFlipEnv, make_env
from actors.envs.handkerchief import PickRule


def make(
    pick_rule: PickRule = "grid", reward_scale: float = 1.0, **options: Any
) -> HandkerchiefFlipEnv:
    return HandkerchiefFlipEnv(
        pick_rule, reward_scale=reward_scale, options=ClothTaskOptions(**options)
    )


@pytest.fixture
def env() -> Iterator[HandkerchiefFlipEnv]:
    """With the engine in a process of its own, which can be lost."""
    env = make(horizon=2, engine="pybullet")
    yield env
    env.close()


def test_gymnasium_s_checker_passes_on_pybullet_too() -> None:
    env = make_env("clothbus/HandkerchiefFlip36-v0", engine="pybullet", render_mode="rgb_array")
    check_env(env)
    env.close()


def test_random_starts_depend_on_the_seed_alone() -> None:
    def start(seed: int) -> np.ndarray:
        env = make_env(
            "clothbus/HandkerchiefFlip60-v0",
            initial_state="folded_over",
            start_shift_m=0.02,
            start_turn_rad=0.3,
        )
        picture, info = env.reset(seed=seed)
        env.close()
        assert info["guard"] is None
        return picture

    first = start(7)
    np.testing.assert_array_equal(first, start(7))
    assert (first != start(8)).any()


def test_an_episode_begins_green_and_flat(env: HandkerchiefFlipEnv) -> None:
    picture, info = env.reset(seed=0)
    assert info == {"success": False, "guard": None, "red_over_flat": 0.0}
    assert cloth_mask(picture).mean() == pytest.approx((0.3 / 0.52) ** 2, rel=0.03)
    assert not red_mask(picture).any()


def test_reward_is_the_red_portion_of_the_picture() -> None:
    env = make(horizon=2, reward_scale=3.0)
    env.reset(seed=0)
    picture, reward, terminated, truncated, info = env.step(2 * 6 + 3)
    env.close()
    assert red_mask(picture).any()
    assert reward == pytest.approx(3.0 * red_mask(picture).mean())
    assert info["red_over_flat"] == pytest.approx(red_mask(picture).sum() / 2304, rel=0.03)
    assert (terminated, truncated) == (False, False)
    assert info["drop_xy_m"] == (-0.12, -0.09)
    column, row = info["pick_px"]
    pick, drop = info["marks"]
    assert (pick.kind, pick.points_px) == ("pick", ((column + 0.5, row + 0.5),))
    ((x_px, y_px),) = drop.points_px
    assert (drop.kind, x_px < 42 < y_px) == ("drop", True)
    assert column > 42 > row


def test_the_horizon_truncates_and_a_new_episode_is_needed(env: HandkerchiefFlipEnv) -> None:
    env.reset(seed=0)
    ends = [env.step(0)[2:4] for _ in range(2)]
    assert ends == [(False, False), (False, True)]
    with pytest.raises(RuntimeError, match=r"got none, or one that is over; call reset\(\)"):
        env.step(0)


def test_a_lost_simulator_truncates_the_episode(env: HandkerchiefFlipEnv) -> None:
    before, _ = env.reset(seed=0)
    engine = env._scene._engine
    assert isinstance(engine, PyBulletProcessEngine)
    assert engine.process_id is not None
    os.kill(engine.process_id, signal.SIGKILL)
    picture, reward, terminated, truncated, info = env.step(0)
    np.testing.assert_array_equal(picture, before)
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert (info["guard"], info["success"]) == ("engine_lost", False)
    with pytest.raises(RuntimeError, match=r"call reset\(\) first"):
        env.step(0)
    _, info = env.reset(seed=0)
    assert info["guard"] is None


def test_an_exploding_cloth_truncates_the_episode() -> None:
    env = make(engine="pybullet", engine_settings={"time_step_secs": 1 / 100})
    before, _ = env.reset(seed=0)
    while True:
        picture, reward, _, truncated, info = env.step(14)
        if truncated:
            break
        before = picture
    env.close()
    assert info["guard"] in ("not_finite", "overstretched", "off_table")
    assert reward == 0.0
    np.testing.assert_array_equal(picture, before)


def test_an_engine_that_breaks_every_cloth_is_an_error() -> None:
    env = make(engine="pybullet", engine_settings={"time_step_secs": 1 / 20})
    with pytest.raises(ClothEngineError, match="expected a sound cloth within 5 attempts"):
        env.reset(seed=0)
    env.close()


def test_a_step_before_reset_is_refused(env: HandkerchiefFlipEnv) -> None:
    with pytest.raises(RuntimeError, match=r"call reset\(\) first"):
        env.step(0)


def test_an_action_out_of_range_is_refused(env: HandkerchiefFlipEnv) -> None:
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action: expected an integer from 0 to 35; got 36"):
        env.step(36)


@pytest.mark.parametrize(
    "argument",
    [
        {"horizon": 0},
        {"engine": "mujoco"},
        {"initial_state": "rolled"},
        {"reward_scale": 0.0},
        {"reward_scale": float("nan")},
        {"randomisation": "some"},
        {"spacing_m": 0.0},
        {"view_half_width_m": 0.0},
        {"start_shift_m": 1.0},
        {"start_turn_rad": -0.1},
        {"render_px": 0},
        {"render_mode": "human"},
    ],
)
def test_arguments_out_of_the_rule_are_refused(argument: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=rf"{next(iter(argument))}: expected .*; got "):
        make(**argument)  # type: ignore[arg-type]


def test_an_unknown_pick_rule_is_refused() -> None:
    with pytest.raises(ValueError, match="pick_rule: expected 'grid' or 'contour'; got 'corner'"):
        make("corner")  # type: ignore[arg-type]
