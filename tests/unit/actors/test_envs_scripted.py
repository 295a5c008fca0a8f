import numpy as np
import pytest

from actors.cloth.camera import Camera
from actors.cloth.meshes import rectangular_sheet
from actors.cloth.pick_points import NoClothInViewError
from actors.cloth.rasteriser import draw_cloth
from actors.demonstrate.scripted import (
    imperfect_action,
    scripted_flip_action,
    scripted_reach_action,
)
from actors.envs import make_env
from actors.envs.handkerchief import DROP_POINTS_M, PickRule

SHEET = rectangular_sheet(12, 0.3)
FLAT_PX = 2348  # of that sheet in that picture


@pytest.mark.parametrize("n_joints", [2, 5, 25])
def test_the_scripted_reach_is_near_the_best_return(n_joints: int) -> None:
    env = make_env("clothbus/Reaching-v0", n_joints=n_joints)
    _, info = env.reset()
    total = 0.0
    for _ in range(30):
        _, reward, _, _, info = env.step(scripted_reach_action(info["joint_angles_rad"]))
        total += float(reward)
    assert total > -20.0  # doing nothing: -50.5; the best that beam search finds: about -18


@pytest.mark.parametrize("pick_rule", ["grid", "contour"])
def test_a_green_cloth_is_rolled_from_its_upper_right_end(pick_rule: PickRule) -> None:
    picture = draw_cloth(SHEET.vertices_m, SHEET.faces, Camera())
    pick, drop = divmod(
        scripted_flip_action(picture, pick_rule, Camera(), FLAT_PX), len(DROP_POINTS_M)
    )
    assert DROP_POINTS_M[drop] == (-0.12, -0.09)
    assert pick == {"grid": 2, "contour": 1}[pick_rule]


def test_a_cloth_too_far_at_the_bottom_left_is_pulled_back() -> None:
    shifted = SHEET.vertices_m + np.array([-0.1, -0.1, 0.0])
    picture = draw_cloth(shifted, SHEET.faces, Camera())
    assert scripted_flip_action(picture, "grid", Camera(), FLAT_PX) == 2 * len(DROP_POINTS_M) + 2


def test_a_red_cloth_is_left_nearly_where_it_lies() -> None:
    turned = SHEET.vertices_m * [-1.0, 1.0, 1.0]
    picture = draw_cloth(turned, SHEET.faces, Camera())
    pick, drop = divmod(
        scripted_flip_action(picture, "grid", Camera(), FLAT_PX), len(DROP_POINTS_M)
    )
    assert pick == drop


def test_no_cloth_in_view_is_an_error() -> None:
    empty = np.full((84, 84, 3), 200, dtype=np.uint8)
    with pytest.raises(NoClothInViewError):
        scripted_flip_action(empty, "grid", Camera(), FLAT_PX)


def test_mistakes_come_at_their_rate() -> None:
    actions = [imperfect_action(7, 1000, 0.3, np.random.default_rng(k)) for k in range(2000)]
    assert np.mean(np.array(actions) != 7) == pytest.approx(0.3, abs=0.05)
    assert imperfect_action(7, 36, 0.0, np.random.default_rng(0)) == 7
    everything = {imperfect_action(7, 3, 1.0, np.random.default_rng(k)) for k in range(50)}
    assert everything == {0, 1, 2}


def test_a_rate_that_is_no_probability_is_refused() -> None:
    with pytest.raises(ValueError, match=r"mistake_rate: expected a probability .* got 1\.5"):
        imperfect_action(0, 36, 1.5, np.random.default_rng(0))
