import numpy as np
import pytest

from actors.cloth.camera import Camera
from actors.cloth.masks import cloth_mask, red_mask
from actors.cloth.meshes import rectangular_sheet
from actors.cloth.pick_points import (
    NoClothInViewError,
    PickPoints,
    contour_pick_points,
    grid_pick_points,
)
from actors.cloth.rasteriser import HANDKERCHIEF_COLOURS, draw_cloth

CAMERA = Camera()
SHEET = rectangular_sheet(12, 0.3)
BOTH_RULES = pytest.mark.parametrize("rule", [grid_pick_points, contour_pick_points])


def _turned_sheet_picture(turn_rad: float) -> np.ndarray:
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    vertices = SHEET.vertices_m.copy()
    vertices[:, :2] = vertices[:, :2] @ np.array([[cosine, sine], [-sine, cosine]])
    return draw_cloth(vertices, SHEET.faces, CAMERA)


def _picture_of(mask: np.ndarray) -> np.ndarray:
    picture = np.empty((*mask.shape, 3), dtype=np.uint8)
    picture[:] = HANDKERCHIEF_COLOURS.table
    picture[mask] = HANDKERCHIEF_COLOURS.front
    return picture


def test_grid_points_lie_row_by_row_in_the_middles_of_cells() -> None:
    mask = np.zeros((84, 84), dtype=bool)
    mask[10:50, 20:80] = True
    points = grid_pick_points(_picture_of(mask))
    columns, rows = [30, 50, 70], [20, 40]
    wanted = [[column, row] for row in rows for column in columns]
    assert np.abs(points - wanted).max() <= 1


def test_grid_points_off_the_cloth_move_onto_it() -> None:
    mask = np.zeros((84, 84), dtype=bool)
    mask[10:50, 20:25] = True
    mask[45:50, 20:80] = True
    points = grid_pick_points(_picture_of(mask))
    assert mask[points[:, 1], points[:, 0]].all()


def test_contour_points_run_clockwise_from_the_top() -> None:
    points = contour_pick_points(_turned_sheet_picture(0.0))
    from_centre = points[:8] - 41.5
    compass = [(0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1)]
    for offset, direction in zip(from_centre, compass, strict=True):
        assert (np.sign(np.where(np.abs(offset) < 4, 0, offset)) == direction).all()


def test_the_inner_points_lie_left_and_right_inside() -> None:
    left, right = contour_pick_points(_turned_sheet_picture(0.0))[8:]
    assert left[0] < 41 < right[0]
    assert np.abs(np.array([left[1], right[1]]) - 41.5).max() <= 1.5


@pytest.mark.parametrize("turn_rad", np.deg2rad([5, 20, 44, 60, 85]))
def test_contour_points_keep_their_directions_when_the_cloth_turns(turn_rad: float) -> None:
    away = contour_pick_points(_turned_sheet_picture(turn_rad))[:8] - 41.5
    direction_deg = np.rad2deg(np.arctan2(away[:, 0], -away[:, 1]))
    off_deg = (direction_deg - 45 * np.arange(8) + 180) % 360 - 180
    assert np.abs(off_deg).max() < 30


@BOTH_RULES
@pytest.mark.parametrize("n_pixels", [1, 2, 5])
def test_a_few_pixels_are_enough(rule: PickPoints, n_pixels: int) -> None:
    mask = np.zeros((84, 84), dtype=bool)
    mask[7, 3 : 3 + n_pixels] = True
    points = rule(_picture_of(mask))
    assert mask[points[:, 1], points[:, 0]].all()


@BOTH_RULES
def test_points_hit_cloth_at_the_picture_s_border(rule: PickPoints) -> None:
    mask = np.zeros((84, 84), dtype=bool)
    mask[0:30, 60:84] = True
    points = rule(_picture_of(mask))
    assert mask[points[:, 1], points[:, 0]].all()


@BOTH_RULES
def test_no_cloth_in_view_is_an_error(rule: PickPoints) -> None:
    with pytest.raises(NoClothInViewError, match="at least one pixel of cloth; got none"):
        rule(_picture_of(np.zeros((84, 84), dtype=bool)))


def test_both_sides_in_any_shade_are_cloth_and_only_one_is_red() -> None:
    shades = np.linspace(0.45, 1.0, 12)
    front = np.floor(np.outer(shades, HANDKERCHIEF_COLOURS.front)).astype(np.uint8)
    back = np.floor(np.outer(shades, HANDKERCHIEF_COLOURS.back)).astype(np.uint8)
    picture = np.stack([front, back])
    assert cloth_mask(picture).all()
    np.testing.assert_array_equal(red_mask(picture), [[False] * 12, [True] * 12])


def test_a_grey_picture_is_refused() -> None:
    with pytest.raises(ValueError, match=r"expected uint8 \[H, W, 3\]; got uint8 \[84, 84, 1\]"):
        cloth_mask(np.zeros((84, 84, 1), dtype=np.uint8))
