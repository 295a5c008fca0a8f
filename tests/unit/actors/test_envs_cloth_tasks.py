"""What every cloth task must do, and the folding tasks one by one."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from actors.cloth.engine import ClothEngineError
from actors.cloth.masks import cloth_mask
from actors.cloth.measures import FAR_ABOVE
from actors.cloth.rasteriser import DAYLIGHT
from actors.demonstrate.acting import scripted_demonstrator
from actors.envs import ENV_IDS, ClothTaskEnv, FoldLinesEnv, TshirtFoldEnv, make_env
from actors.envs.difficulties import DIFFICULTIES
from actors.envs.fold_lines import FoldAlong
from actors.envs.fold_targets import scripted_target
from actors.envs.initial_states import INITIAL_STATES
from actors.envs.randomisation import RANDOMISATIONS, SIM2REAL, Randomisation, make_randomisation

CLOTH_IDS = [env_id for env_id in ENV_IDS if "Reaching" not in env_id]


def make(env_id: str, **given: Any) -> ClothTaskEnv:
    env = make_env(env_id if "/" in env_id else f"clothbus/{env_id}-v0", **given).unwrapped
    assert isinstance(env, ClothTaskEnv)
    return env


def play(env: ClothTaskEnv, seed: int, mistake_rate: float = 0.0) -> dict[str, Any]:
    """An episode of the scripted expert; its last info."""
    expert = scripted_demonstrator(env, env.n_actions, mistake_rate)
    random = np.random.default_rng(seed)
    picture, info = env.reset(seed=seed)
    truncated = False
    while not truncated:
        picture, _, _, truncated, info = env.step(expert.act(picture, random, 0.0))
    return info


@pytest.mark.parametrize("env_id", CLOTH_IDS)
def test_gymnasium_s_checker_passes(env_id: str) -> None:
    env = make_env(env_id, render_mode="rgb_array")
    check_env(env)
    env.close()


@pytest.mark.parametrize("env_id", CLOTH_IDS)
@pytest.mark.parametrize("initial_state", INITIAL_STATES)
def test_each_initial_state_is_the_seeds_alone_and_a_sound_cloth(
    env_id: str, initial_state: str
) -> None:
    env, again = make(env_id, initial_state=initial_state), make(env_id)
    picture, info = env.reset(seed=5)
    assert info["guard"] is None
    assert not info["success"]
    same, _ = again.reset(seed=5, options={"initial_state": initial_state})
    np.testing.assert_array_equal(picture, same)
    flat, _ = again.reset(seed=5, options={"initial_state": "flat"})
    assert (initial_state == "flat") == np.array_equal(picture, flat)
    if initial_state not in ("flat", "shifted", "rotated"):
        other, _ = again.reset(seed=6, options={"initial_state": initial_state})
        assert (picture != other).any()


@pytest.mark.parametrize("env_id", CLOTH_IDS)
def test_an_episode_depends_on_its_seed_alone(env_id: str) -> None:
    def pictures() -> list[np.ndarray]:
        env = make(env_id, randomisation="sim2real", initial_state="creased")
        seen = [env.reset(seed=11)[0]]
        random = np.random.default_rng(2)
        for _ in range(2):
            picture, *_, info = env.step(int(random.integers(env.n_actions)))
            seen.append(picture)
            assert info["guard"] is None
        return seen

    np.testing.assert_array_equal(pictures(), pictures())


@pytest.mark.parametrize("env_id", CLOTH_IDS)
def test_the_actions_and_the_reward_of_an_episode_in_range(env_id: str) -> None:
    env = make(env_id)
    env.reset(seed=0)
    _, reward, terminated, _, info = env.step(env.n_actions - 1)
    assert np.isfinite(reward)
    assert not terminated
    assert info["guard"] is None
    with pytest.raises(ValueError, match=f"expected an integer from 0 to {env.n_actions - 1}"):
        env.step(env.n_actions)


@pytest.mark.parametrize("env_id", ["ShirtFold", "TrousersFold", "HandkerchiefFold"])
def test_the_scripted_folds_succeed_from_elsewhere_too(env_id: str) -> None:
    env = make(env_id)
    infos = [play(env, seed) for seed in range(3)]
    assert all(info["success"] for info in infos), infos
    assert play(make(env_id, initial_state="rotated"), 1)["particle_distance_m"] < 0.04


@pytest.mark.parametrize("env_id", [env_id for env_id in CLOTH_IDS if "Flip" not in env_id])
def test_difficulties_differ_and_options_overrule_them(env_id: str) -> None:
    def options(**given: Any) -> Any:
        return make(env_id, **given).options

    easy, medium, hard = (options(difficulty=name) for name in DIFFICULTIES)
    assert medium == options()
    assert len({repr(easy), repr(medium), repr(hard)}) == 3
    assert options(difficulty="hard", start_turn_rad=0.0).start_turn_rad == 0.0
    with pytest.raises(ValueError, match="difficulty: expected one of easy, medium, hard"):
        make(env_id, difficulty="extreme")


def test_wrong_folds_fail() -> None:
    env = make("ShirtFold")
    for actions in [(4, 4, 4), (0, 0, 0), (1, 4, 4)]:
        env.reset(seed=0)
        for action in actions:
            *_, info = env.step(action)
        assert not info["success"], actions
        assert set(info) >= {"iou", "particle_distance_m", "fold_line_m", "grasps_m", "drops_m"}


def test_the_scripted_tshirt_is_folded_and_its_reward_grows() -> None:
    env = make("TShirtFold")
    assert isinstance(env, TshirtFoldEnv)
    info = play(env, 0)
    assert info["sleeves_folded"]
    assert info["success"], info


def test_a_target_is_much_smaller_than_the_garment_and_made_once() -> None:
    env = make("ShirtFold")
    assert isinstance(env, FoldLinesEnv)
    env.reset(seed=0)
    target = scripted_target(env.garment, tuple(map(FoldAlong, (0, 2, 4))))
    assert target is scripted_target(env.garment, tuple(map(FoldAlong, (0, 2, 4))))
    assert target.mask(env.camera).sum() < 0.5 * env.flat_px


@pytest.mark.parametrize("env_id", ["ShirtFold", "TrousersFold", "HandkerchiefFold"])
def test_a_target_is_the_same_fold_whatever_the_mesh(env_id: str) -> None:
    fine, coarse = make(env_id), make(env_id, engine="pybullet")
    targets = []
    for env in (fine, coarse):
        assert isinstance(env, FoldLinesEnv)
        garment = env._make_garment()
        script = tuple(FoldAlong(env.task.lines[action]) for action in env.task.script)
        targets.append(scripted_target(garment, script))
        env.close()
    usual, other = targets
    assert len(other.vertices_in_world) == len(other.garment.mesh.vertices_m)
    assert other.vertices_in_world[:, 2].max() < 1.5 * usual.vertices_in_world[:, 2].max()
    assert usual.iou(other.mask(FAR_ABOVE), FAR_ABOVE) > 0.85


@pytest.mark.timeout(300)
def test_what_the_script_folds_on_the_other_engine_is_folded_by_the_same_thresholds() -> None:
    env = make("ShirtFold", engine="pybullet", horizon=3)
    info = play(env, 0)
    assert info["success"], info
    env.close()


def test_randomisation_is_off_by_default_and_bounded() -> None:
    usual = Randomisation().draw(np.random.default_rng(0))
    assert (usual.size, usual.stiffness, usual.friction, usual.light) == (1.0, 1.0, 1.0, DAYLIGHT)
    random = np.random.default_rng(1)
    sizes = np.array([SIM2REAL.draw(random).size for _ in range(200)])
    assert np.abs(sizes - 1).max() <= 0.1
    assert np.ptp(sizes) > 0.15
    beyond = np.array([RANDOMISATIONS["held_out"].draw(random).size for _ in range(200)])
    assert (np.abs(beyond - 1) >= 0.1).all()
    assert (np.abs(beyond - 1) <= 0.15 + 1e-12).all()
    assert make_randomisation({"noise": 3.0}) == Randomisation(noise=3.0)


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ("wild", "randomisation: expected one of off, sim2real"),
        ({"colour": 1.0}, "expected some of size, .*; got colour"),
        ({"size": 0.9}, "randomisation.size: expected a number from 0 to 0.25; got 0.9"),
        ({"creases": -1}, "randomisation.creases: expected an integer of at least 0"),
    ],
)
def test_impossible_randomisations_are_refused(given: Any, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        make_randomisation(given)


def test_size_noise_and_luck_change_what_they_name() -> None:
    plain = make("HandkerchiefFlip36")
    usual, _ = plain.reset(seed=0)
    larger = make("HandkerchiefFlip36", randomisation={"size": 0.2})
    assert (cloth_mask(larger.reset(seed=0)[0]).sum() != cloth_mask(usual).sum()).any()
    noisy, _ = make("HandkerchiefFlip36", randomisation={"noise": 5.0}).reset(seed=0)
    difference = noisy.astype(int) - usual
    assert 3 < difference.std() < 6
    unlucky = make("HandkerchiefFlip36", randomisation={"missed_grasps": 0.5}, horizon=10)
    before, _ = unlucky.reset(seed=0)
    stayed = 0
    for _ in range(10):
        picture, *_ = unlucky.step(8)
        stayed += np.array_equal(picture, before)
        before = picture
    assert 1 <= stayed <= 9


def test_the_robot_can_make_every_flip() -> None:
    env = make("HandkerchiefFlip36", robot=True)
    picture, info = env.reset(seed=0)
    assert info["action_mask"].all()
    moved, _, _, _, info = env.step(2 * 6 + 3)
    assert info["unreachable"] is None
    motion = info["motion"]
    assert motion.joints_rad.shape == (len(motion.times_secs), len(motion.names))
    assert env.reset(seed=0)[1].get("motion") is None
    assert (moved != picture).any()
    env.close()


def test_what_the_robot_cannot_do_is_masked_reported_and_not_done() -> None:
    """Standing where two hands in one line before it are in each other's way."""
    env = make("HandkerchiefFold", robot=True, robot_stance="front", horizon=6)
    picture, info = env.reset(seed=0)
    n_refused = 0
    for action in (1, 2, 0, 1, 2):
        mask, before = info["action_mask"], picture
        assert mask.shape == (3,)
        picture, _, _, _, info = env.step(action)
        assert (info["unreachable"] is None) == bool(mask[action])
        if info["unreachable"] is not None:
            n_refused += 1
            assert info["unreachable"] in {"out_of_reach", "joint_limit", "self_collision"}
            assert (info["marks"], info["motion"]) == ((), None)
            np.testing.assert_array_equal(picture, before)
    assert 0 < n_refused < 5
    assert env.action_space.sample(info["action_mask"]) in np.flatnonzero(info["action_mask"])
    env.close()


@pytest.mark.parametrize("env_id", ["ShirtFold", "TrousersFold", "HandkerchiefFold"])
def test_the_robot_can_make_the_scripted_folds_and_they_succeed(env_id: str) -> None:
    env = make(env_id, robot=True)
    env.reset(seed=1)
    for action in env.task.script:  # type: ignore[attr-defined]
        _, _, _, _, info = env.step(action)
        assert info["unreachable"] is None
    assert info["success"]
    env.close()


@pytest.mark.parametrize("engine", ["xpbd", "pybullet"])
def test_gymnasium_s_checker_passes_with_the_robot(engine: str) -> None:
    options = {"engine": engine, "sizes": {"side_m": 0.16}, "spacing_m": 0.04, "robot": True}
    env = make_env("clothbus/HandkerchiefFold-v0", render_mode="rgb_array", **options)
    check_env(env)
    env.close()


def test_a_filmed_robot_changes_nothing_and_is_seen_to_move() -> None:
    env, unseen = (
        make("HandkerchiefFold", robot=True, render_px=64),
        make("HandkerchiefFold", robot=True, render_px=64),
    )
    assert env.arms is not None
    env.arms.film_every_secs = 0.5
    for each in (env, unseen):
        each.reset(seed=0)
        assert each.robot_film() == []
    one, two = env.step(0), unseen.step(0)
    np.testing.assert_array_equal(one[0], two[0])
    assert unseen.robot_film() == []
    film = env.robot_film()
    assert len(film) > 10
    assert {picture.shape for picture in film} == {(64, 64, 3)}
    assert all((a != b).any() for a, b in pairwise(film))
    env.close()
    unseen.close()


@pytest.mark.parametrize("env_id", ["ShirtFold", "TShirtFold"])
def test_a_lost_simulator_truncates_a_fold_with_the_measures_before_it(
    env_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make(env_id)
    picture, before = env.reset(seed=0)

    def lose(*_: object) -> None:
        env._scene._engine.close()
        raise ClothEngineError

    monkeypatch.setattr(env._scene._engine, "perform", lose)
    after, reward, _, truncated, info = env.step(0)
    np.testing.assert_array_equal(after, picture)
    assert (reward, truncated, info["guard"]) == (0.0, True, "engine_lost")
    assert info["particle_distance_m"] == before["particle_distance_m"]
