import gymnasium
import pytest

import actors.envs
from actors.envs import ENV_IDS, HandkerchiefFlipEnv, ReachingEnv, TshirtFoldEnv, make_env
from actors.envs.tshirt import VIEW_HALF_WIDTH_M


def test_the_ids_are_registered_with_gymnasium() -> None:
    assert set(ENV_IDS) <= set(gymnasium.registry)
    assert not any(gymnasium.registry[env_id].nondeterministic for env_id in ENV_IDS)


def test_each_id_makes_its_task() -> None:
    assert isinstance(make_env("clothbus/Reaching-v0"), ReachingEnv)
    for env_id, n_actions in [("HandkerchiefFlip36", 36), ("HandkerchiefFlip60", 60)]:
        env = make_env(f"clothbus/{env_id}-v0", horizon=5)
        assert isinstance(env, HandkerchiefFlipEnv)
        assert env.action_space.n == n_actions  # type: ignore[attr-defined]
        env.close()


def test_the_t_shirt_is_seen_as_its_drop_points_expect() -> None:
    env = make_env("clothbus/TShirtFold-v0")
    assert isinstance(env, TshirtFoldEnv)
    assert env.options.view_half_width_m == VIEW_HALF_WIDTH_M
    env.close()


def test_a_name_that_is_no_class_of_a_task_is_refused() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'ShirtFoldEnv'"):
        _ = actors.envs.ShirtFoldEnv  # type: ignore[attr-defined]


def test_an_unknown_id_names_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"expected one of .*Flip36-v0.*; got 'Reaching'"):
        make_env("Reaching")


def test_an_unknown_argument_names_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"expected some of the arguments n_joints.*; got joints"):
        make_env("clothbus/Reaching-v0", joints=3)


def test_a_bad_argument_is_refused_by_the_task() -> None:
    with pytest.raises(ValueError, match="n_joints: expected an integer of at least 1; got 0"):
        make_env("clothbus/Reaching-v0", n_joints=0)
