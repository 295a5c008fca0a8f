import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.cloth.camera import Camera
from actors.cloth.masks import cloth_mask, red_mask
from actors.cloth.meshes import rectangular_sheet
from actors.cloth.rasteriser import HANDKERCHIEF_COLOURS, ClothColours, Light, Paint, draw_cloth

CAMERA = Camera()
SHEET = rectangular_sheet(12, 0.3)


def _jittered_sheet(seed: int) -> np.ndarray:
    jitter = np.random.default_rng(seed).uniform(-0.006, 0.006, SHEET.vertices_m.shape)
    inner = np.abs(SHEET.vertices_m[:, :2]).max(axis=1) < 0.149
    jitter[:, 2] = 0.0
    return SHEET.vertices_m + jitter * inner[:, None]


def test_a_flat_cloth_covers_its_projected_area() -> None:
    picture = draw_cloth(SHEET.vertices_m, SHEET.faces, CAMERA)
    assert cloth_mask(picture).sum() == pytest.approx((0.3 * CAMERA.px_per_m) ** 2, rel=0.02)
    assert not red_mask(picture).any()
    assert (picture[0, 0] == HANDKERCHIEF_COLOURS.table).all()


def test_a_cloth_upside_down_is_red() -> None:
    turned = SHEET.vertices_m * [-1.0, 1.0, 1.0]
    picture = draw_cloth(turned, SHEET.faces, CAMERA)
    flat = draw_cloth(SHEET.vertices_m, SHEET.faces, CAMERA)
    np.testing.assert_array_equal(red_mask(picture), cloth_mask(flat))


@settings(deadline=None, max_examples=5)
@given(st.integers(0, 10_000))
def test_each_pixel_of_a_flat_cloth_belongs_to_exactly_one_triangle(seed: int) -> None:
    vertices = _jittered_sheet(seed)
    whole = cloth_mask(draw_cloth(vertices, SHEET.faces, CAMERA))
    times_covered = np.zeros(whole.shape, dtype=int)
    for face in SHEET.faces:
        times_covered += cloth_mask(draw_cloth(vertices, face[None], CAMERA))
    np.testing.assert_array_equal(times_covered, whole)


def test_the_nearer_layer_hides_the_other_whatever_the_order() -> None:
    below = rectangular_sheet(2, 0.2)
    above = below.vertices_m * [-1.0, 1.0, 1.0] + [0.0, 0.0, 0.01]
    vertices = np.concatenate([below.vertices_m, above])
    faces = np.concatenate([below.faces, below.faces + np.int32(4)])
    forwards = draw_cloth(vertices, faces, CAMERA)
    backwards = draw_cloth(vertices, faces[::-1], CAMERA)
    np.testing.assert_array_equal(forwards, backwards)
    np.testing.assert_array_equal(red_mask(forwards), cloth_mask(forwards))


def test_two_sheets_that_cross_are_cut_where_they_meet() -> None:
    flat = rectangular_sheet(2, 0.2)
    slope = flat.vertices_m * [-1.0, 1.0, 1.0]
    slope[:, 2] = 0.2 * slope[:, 0]
    vertices = np.concatenate([flat.vertices_m, slope])
    faces = np.concatenate([flat.faces, flat.faces + np.int32(4)])
    red = red_mask(draw_cloth(vertices, faces, CAMERA))
    columns = np.flatnonzero(red.any(axis=0))
    assert columns.min() == 42
    assert red[42, 42:56].all()


def test_raised_cloth_looks_larger() -> None:
    raised = SHEET.vertices_m + np.array([0.0, 0.0, 0.3])
    larger = cloth_mask(draw_cloth(raised, SHEET.faces, CAMERA)).sum()
    flat = cloth_mask(draw_cloth(SHEET.vertices_m, SHEET.faces, CAMERA)).sum()
    assert larger / flat == pytest.approx((1.2 / 0.9) ** 2, rel=0.03)


def test_a_slope_away_from_the_light_is_darker() -> None:
    towards, away = SHEET.vertices_m.copy(), SHEET.vertices_m.copy()
    towards[:, 2] = -0.3 * towards[:, 0] + 0.05
    away[:, 2] = 0.3 * away[:, 0] + 0.05
    bright = draw_cloth(towards, SHEET.faces, CAMERA)[42, 42, 1]
    assert bright > draw_cloth(away, SHEET.faces, CAMERA)[42, 42, 1]


def test_cloth_partly_outside_of_the_picture_is_cut() -> None:
    shifted = SHEET.vertices_m + np.array([0.26, 0.0, 0.0])
    mask = cloth_mask(draw_cloth(shifted, SHEET.faces, CAMERA))
    flat = cloth_mask(draw_cloth(SHEET.vertices_m, SHEET.faces, CAMERA))
    np.testing.assert_array_equal(mask[:, 42:], flat[:, :42])
    assert not mask[:, :42].any() or mask[:, :42].sum() < 0.5 * flat.sum()


def test_the_cloth_may_be_any_other_colours() -> None:
    picture = draw_cloth(
        SHEET.vertices_m, SHEET.faces, CAMERA, ClothColours((0, 0, 250), (0, 250, 0), (9, 9, 9))
    )
    assert picture[42, 42].argmax() == 2
    assert (picture[0, 0] == 9).all()


def test_a_broken_cloth_is_not_drawn() -> None:
    broken = SHEET.vertices_m.copy()
    broken[3, 1] = np.nan
    with pytest.raises(ValueError, match="expected finite coordinates"):
        draw_cloth(broken, SHEET.faces, CAMERA)
    broken[3] = [0.0, 0.0, 1.3]
    with pytest.raises(ValueError, match=r"below the camera's 1\.2 m; got 1\.300 m"):
        draw_cloth(broken, SHEET.faces, CAMERA)


def test_the_camera_finds_table_points_again() -> None:
    for point_m in [(0.0, 0.0), (0.12, -0.09), (-0.26, 0.26)]:
        x_px, y_px = CAMERA.project_px(np.array([*point_m, 0.0]))
        assert CAMERA.table_point_m((x_px, y_px)) == pytest.approx(point_m)
    corner = CAMERA.project_px(np.array([-0.26, 0.26, 0.0]))
    np.testing.assert_allclose(corner, [0.0, 0.0], atol=1e-9)


def test_an_oblique_turned_camera_finds_table_points_again() -> None:
    camera = Camera(x_m=0.1, y_m=-0.4, target_x_m=0.02, target_y_m=0.03, roll_rad=0.2)
    points_m = np.array([(0.0, 0.0), (0.12, -0.09), (-0.2, 0.2), (0.02, 0.03)])
    points_px = camera.project_px(np.concatenate([points_m, np.zeros((4, 1))], axis=1))
    np.testing.assert_allclose(camera.table_points_m(points_px), points_m, atol=1e-12)
    np.testing.assert_allclose(points_px[3], [42.0, 42.0])
    rotation = camera.rotation_from_world
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    seen = camera.intrinsics @ rotation @ (np.array([0.1, 0.1, 0.05]) - camera.position_in_world)
    expected = camera.project_px(np.array([0.1, 0.1, 0.05]))
    np.testing.assert_allclose(seen[:2] / seen[2], expected)


def test_paint_and_light_change_the_colours_alone() -> None:
    green = np.tile(np.array([10, 200, 90], np.uint8), (len(SHEET.faces), 1))
    usual = draw_cloth(SHEET.vertices_m, SHEET.faces, CAMERA)
    painted = draw_cloth(SHEET.vertices_m, SHEET.faces, CAMERA, paint=Paint(green, green))
    dark = draw_cloth(SHEET.vertices_m, SHEET.faces, CAMERA, light=Light(strength=0.5))
    cloth = cloth_mask(usual)
    assert (painted[~cloth] == usual[~cloth]).all()
    assert (painted[cloth] != usual[cloth]).any(axis=1).all()
    np.testing.assert_allclose(dark, usual // 2, atol=1)
    with pytest.raises(ValueError, match=r"Light\.direction: expected a direction upwards"):
        Light(direction=(1.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"expected ambient from 0 to 1 and strength from 0\.2"):
        Light(strength=3.0)


@pytest.mark.parametrize("name", ["size_px", "view_half_width_m", "height_m"])
def test_an_impossible_camera_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"Camera\.{name}: expected a positive number; got 0"):
        Camera(**{name: 0})


def test_an_impossible_colour_is_refused() -> None:
    with pytest.raises(ValueError, match=r"ClothColours\.back: expected 3 numbers"):
        ClothColours(back=(300, 0, 0))
