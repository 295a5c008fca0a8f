from typing import Any

import numpy as np
import pytest

from actors.cloth.guard import GuardReason
from actors.cloth.masks import red_mask
from actors.cloth.measures import true_coverage
from actors.cloth.spreading import SpreadAim
from actors.envs import ClothTaskEnv, make_env
from actors.envs.scene import Scene

BY_HAND = {"reset_actions": 0, "reset_end": None, "reset_by_hand": True}


def make(env_id: str = "HandkerchiefFlip36", **given: Any) -> ClothTaskEnv:
    env = make_env(f"clothbus/{env_id}-v0", **{"automatic_reset": True, **given}).unwrapped
    assert isinstance(env, ClothTaskEnv)
    return env


def reset_keys(info: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in info.items() if name.startswith("reset_")}


def crumpling_steps(env: ClothTaskEnv) -> np.ndarray:
    for action in (14, 3):
        env.step(action)
    return env.vertices_in_world()


def test_the_next_episode_begins_with_the_same_cloth_spread_again() -> None:
    env = make()
    _, info = env.reset(seed=3)
    assert reset_keys(info) == BY_HAND
    before = crumpling_steps(env)
    assert true_coverage(before, env.garment) < 0.9
    picture, info = env.reset()
    assert (info["reset_end"], info["reset_by_hand"], info["guard"]) == ("spread", False, None)
    assert info["reset_actions"] > 0
    assert true_coverage(env.vertices_in_world(), env.garment) > 0.9
    assert red_mask(picture).sum() < 0.1 * env.flat_px
    assert env.steps_done == 0
    *_, truncated, _ = env.step(0)
    assert not truncated


def test_a_seed_and_the_cloth_s_history_decide_alone() -> None:
    def beginning() -> np.ndarray:
        env = make(initial_state="folded_over")
        env.reset(seed=3)
        crumpling_steps(env)
        env.reset(seed=4)
        return env.vertices_in_world()

    np.testing.assert_array_equal(beginning(), beginning())


def test_what_spreading_cannot_do_is_done_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make()
    env.reset(seed=3)
    _, info = env.reset(options={"initial_state": "rotated"})
    assert reset_keys(info) == BY_HAND
    with monkeypatch.context() as patch:
        patch.setattr(Scene, "perform", lambda *_: GuardReason.NOT_FINITE)
        *_, info = env.step(0)
    assert info["guard"] == "not_finite"
    _, info = env.reset()
    assert reset_keys(info) == BY_HAND
    env.close()
    _, info = env.reset()
    assert reset_keys(info) == BY_HAND


@pytest.mark.parametrize(
    ("reason", "end"),
    [(GuardReason.OUT_OF_VIEW, "no_cloth_in_view"), (GuardReason.OFF_TABLE, "table_lost")],
)
def test_spreading_that_fails_leaves_the_rest_to_a_hand(
    reason: GuardReason, end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make()
    env.reset(seed=3)
    crumpling_steps(env)
    with monkeypatch.context() as patch:
        patch.setattr(Scene, "perform", lambda *_: reason)
        _, info = env.reset()
    assert reset_keys(info) == {"reset_actions": 1, "reset_end": end, "reset_by_hand": True}
    assert true_coverage(env.vertices_in_world(), env.garment) == pytest.approx(1.0, abs=0.01)


def test_arms_that_reach_nothing_leave_the_cloth_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make()
    env.reset(seed=3)
    before = crumpling_steps(env)
    monkeypatch.setattr(ClothTaskEnv, "_attempt", lambda *_: ("too far", None))
    assert env.spread(SpreadAim(actions=3)).end == "out_of_actions"
    np.testing.assert_array_equal(before, env.vertices_in_world())


def test_other_garments_are_refused() -> None:
    with pytest.raises(ValueError, match=r"automatic_reset: expected .* got one with a shirt"):
        make("ShirtFold")


def test_crumpled_is_well_below_the_flat_area() -> None:
    env = make(initial_state="crumpled")
    for seed in range(3):
        env.reset(seed=seed)
        env.close()
        assert true_coverage(env.vertices_in_world(), env.garment) < 0.75


def test_without_the_option_nothing_is_said_of_it() -> None:
    _, info = make(automatic_reset=False).reset(seed=3)
    assert reset_keys(info) == {}
