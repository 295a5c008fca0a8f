from typing import cast

import pytest

from actors.demonstrate.looking_ahead import KEEPS, FlipExpert
from actors.envs import HandkerchiefFlipEnv, make_env

COARSE = {"spacing_m": 0.3 / 11}


def make(**given: object) -> HandkerchiefFlipEnv:
    return cast(HandkerchiefFlipEnv, make_env("clothbus/HandkerchiefFlip36-v0", **given).unwrapped)


def test_what_is_foreseen_comes_to_pass_on_its_own_engine() -> None:
    env = make(**COARSE)
    env.reset(seed=1)
    expert = FlipExpert(env)
    for action in (15, 2, 21):
        foreseen = expert.foreseen(action)
        *_, info = env.step(action)
        assert info["red_over_flat"] == foreseen


@pytest.mark.parametrize("engine", ["pybullet", "xpbd"])
def test_the_expert_flips_the_cloth(engine: str) -> None:
    env = make(horizon=8, engine=engine, **COARSE)
    _, info = env.reset(seed=0)
    truncated = False
    while not (truncated or info["success"]):
        *_, truncated, info = env.step(FlipExpert(env).action())
    env.close()
    assert info["success"]


def test_a_flipped_cloth_is_left_nearly_where_it_lies() -> None:
    env = make(**COARSE)
    env.reset(seed=0)
    flipped = env.garment.mesh.vertices_m * [-1.0, 1.0, 1.0]
    env._scene._engine.reset(env.garment.mesh, flipped)
    assert env._scene._see() is None
    expert = FlipExpert(env)
    pick, drop = divmod(expert.action(), 6)
    assert pick == drop
    *_, info = env.step(expert.action())
    assert info["red_over_flat"] >= KEEPS


def test_an_action_that_breaks_the_cloth_is_foreseen(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make(**COARSE)
    env.reset(seed=0)
    monkeypatch.setattr("actors.cloth.guard.MOST_STRETCH", 0.5)
    assert FlipExpert(env).foreseen(0) == -1.0
