import numpy as np
import pytest

from actors.cloth.camera import Camera
from actors.cloth.garments import make_garment
from actors.cloth.markers import TSHIRT_MARKERS, found_markers, painted
from actors.cloth.rasteriser import ClothColours, draw_cloth
from actors.envs.tshirt_reward import INITIAL_HEMS, TshirtReward

COLOURS = ClothColours(front=(50, 80, 190), back=(120, 150, 225))
CAMERA = Camera(view_half_width_m=0.32)
TSHIRT = make_garment("tshirt")


def _picture(vertices: np.ndarray) -> np.ndarray:
    paint = painted(TSHIRT, COLOURS, TSHIRT_MARKERS)
    return draw_cloth(vertices, TSHIRT.mesh.faces, CAMERA, COLOURS, paint=paint)


@pytest.mark.parametrize("shift_m", [(0.0, 0.0), (0.05, -0.04), (-0.06, 0.03)])
def test_each_marker_is_found_at_its_keypoint(shift_m: tuple[float, float]) -> None:
    vertices = TSHIRT.mesh.vertices_m + np.array([*shift_m, 0.0])
    found = found_markers(_picture(vertices), TSHIRT_MARKERS)
    assert set(found) == set(TSHIRT_MARKERS)
    for name, place in found.items():
        expected = CAMERA.project_px(vertices[TSHIRT.keypoints[name]]) / 84
        np.testing.assert_allclose(place, expected, atol=0.04)


def test_a_marker_that_lies_face_down_is_not_seen() -> None:
    vertices = TSHIRT.mesh.vertices_m.copy()
    sleeve = vertices[:, 0] > 0.12
    vertices[sleeve, 0] = 0.24 - vertices[sleeve, 0]
    vertices[sleeve, 2] += 0.01
    found = found_markers(_picture(vertices), TSHIRT_MARKERS)
    assert set(found) == {"sleeve_left", "hem_left", "hem_right"}


def test_the_hems_markers_are_seen_from_behind_too() -> None:
    behind = TSHIRT.mesh.vertices_m * [-1.0, 1.0, 1.0]
    assert set(found_markers(_picture(behind), TSHIRT_MARKERS)) == {"hem_left", "hem_right"}


def test_the_spread_tshirts_hem_is_where_algorithm_3_has_it() -> None:
    found = found_markers(_picture(TSHIRT.mesh.vertices_m), TSHIRT_MARKERS)
    for name, place in INITIAL_HEMS.items():
        np.testing.assert_allclose(found[name], place, atol=0.03)


def test_a_garment_without_the_keypoints_is_refused() -> None:
    with pytest.raises(ValueError, match=r"garment trousers: expected keypoints .* sleeve_left"):
        painted(make_garment("trousers"), COLOURS, TSHIRT_MARKERS)


SPREAD = INITIAL_HEMS | {"sleeve_right": (0.8, 0.4), "sleeve_left": (0.2, 0.4)}


def _without(*names: str) -> dict[str, tuple[float, float]]:
    return {name: place for name, place in SPREAD.items() if name not in names}


def test_while_sleeves_are_out_their_distance_from_the_hems_centre_counts() -> None:
    reward = TshirtReward()
    assert reward(SPREAD) == pytest.approx(-2 * (0.3 + 0.4))
    assert reward(_without("sleeve_left")) == pytest.approx(-0.7)


def test_once_both_sleeves_are_in_the_hem_counts() -> None:
    reward = TshirtReward()
    reward(SPREAD)
    assert reward(dict(INITIAL_HEMS)) == pytest.approx(1.0)
    halfway = {"hem_right": (0.675, 0.504), "hem_left": (0.325, 0.504)}
    assert reward(halfway) == pytest.approx(1.0 + 2 * 0.296)
    assert reward({}) == pytest.approx(1.0 + 2 * 0.296), "a hidden hem stays where it was"
    assert reward.sleeves_folded({})


def test_a_sleeve_that_left_the_picture_is_not_folded_in() -> None:
    reward = TshirtReward()
    reward(SPREAD | {"sleeve_right": (0.97, 0.4)})
    gone = _without("sleeve_right", "sleeve_left")
    assert reward(gone) == pytest.approx(-(0.47 + 0.4))
    assert not reward.sleeves_folded(gone)


def test_the_literal_form_tests_what_is_printed() -> None:
    reward = TshirtReward("literal")
    assert reward(SPREAD) == pytest.approx(-1.4), "both markers seen: sleeves, and hems at 0"
    assert reward({name: SPREAD[name] for name in ("sleeve_left", "sleeve_right")}) == 1.0
    assert reward(dict(INITIAL_HEMS)) == pytest.approx(-1.4)
    with pytest.raises(ValueError, match="reward_form: expected 'corrected' or 'literal'"):
        TshirtReward("swapped")  # type: ignore[arg-type]
