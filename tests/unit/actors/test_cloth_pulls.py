import numpy as np
import pytest

from actors.cloth.camera import Camera
from actors.cloth.masks import Side, cloth_mask, side_masks
from actors.cloth.meshes import rectangular_sheet
from actors.cloth.pick_points import NoClothInViewError
from actors.cloth.pulls import (
    Pull,
    PullKind,
    centring_pull,
    spreading_pulls,
    touches_border,
    turning_pull,
)
from actors.cloth.rasteriser import draw_cloth

SHEET = rectangular_sheet(20, 0.3)
EMPTY = np.full((84, 84, 3), 200, dtype=np.uint8)


def picture(vertices: np.ndarray, camera: Camera | None = None) -> np.ndarray:
    return draw_cloth(vertices, SHEET.faces, camera or Camera())


def shifted(x_m: float, y_m: float) -> np.ndarray:
    return SHEET.vertices_m + np.array([x_m, y_m, 0.0])


def folded(at_m: float) -> np.ndarray:
    """The upper right corner folded over the line x + y = 2 at_m, which shows the red side."""
    vertices = SHEET.vertices_m.copy()
    beyond = vertices[:, :2].sum(axis=1) / 2 - at_m
    flap = beyond > 0
    vertices[flap, :2] -= 2 * beyond[flap, None]
    vertices[flap, 2] = 0.005
    return vertices


def flat_px(camera: Camera) -> int:
    return int(cloth_mask(picture(SHEET.vertices_m, camera)).sum())


def best(vertices: np.ndarray, camera: Camera) -> Pull:
    pulls = spreading_pulls(picture(vertices, camera), flat_px(camera))
    return max(pulls, key=lambda pull: pull.promise_px)


@pytest.mark.parametrize("size_px", [84, 168])
@pytest.mark.parametrize("at_m", [0.06, 0.09])
def test_a_folded_corner_is_carried_back_across_its_fold(size_px: int, at_m: float) -> None:
    camera = Camera(size_px)
    pull = best(folded(at_m), camera)
    tip_m = 2 * at_m - 0.15
    assert pull.kind is PullKind.UNFOLD
    assert camera.table_point_m(pull.pick_px) == pytest.approx((tip_m, tip_m), abs=0.025)
    assert camera.table_point_m(pull.drop_px) == pytest.approx((0.15, 0.15), abs=0.045)


def test_what_a_fold_hides_is_what_its_best_pull_promises() -> None:
    camera = Camera()
    hidden_px = flat_px(camera) - int(cloth_mask(picture(folded(0.06))).sum())
    assert 0.5 * hidden_px < best(folded(0.06), camera).promise_px <= hidden_px


def test_the_ends_of_shrunken_cloth_are_pulled_outwards() -> None:
    shrunken = SHEET.vertices_m * [0.8, 0.8, 1.0]
    pulls = spreading_pulls(picture(shrunken), flat_px(Camera()))
    stretching = [pull for pull in pulls if pull.kind is PullKind.STRETCH]
    assert len(stretching) == 4
    for pull in stretching:
        pick, drop = np.array(pull.pick_px) - 42, np.array(pull.drop_px) - 42
        assert np.linalg.norm(drop) > np.linalg.norm(pick) + 5
        assert drop @ pick > 0.95 * np.linalg.norm(drop) * np.linalg.norm(pick)


@pytest.mark.parametrize(("up", "is_opened"), [(None, True), ("green", True), ("red", False)])
def test_a_flap_that_shows_the_side_asked_for_is_not_opened(
    up: Side | None, is_opened: bool
) -> None:
    seen = picture(folded(0.06))
    flap = side_masks(seen)["red"]
    opening = [
        pull
        for pull in spreading_pulls(seen, flat_px(Camera()), up)
        if pull.kind is PullKind.UNFOLD and flap[int(pull.pick_px[1]), int(pull.pick_px[0])]
    ]
    assert bool(opening) is is_opened


def test_every_pick_point_lies_on_cloth() -> None:
    seen = picture(folded(0.03))
    mask = cloth_mask(seen)
    for pull in spreading_pulls(seen, flat_px(Camera())):
        column, row = (int(coordinate) for coordinate in pull.pick_px)
        assert mask[row, column]


def test_cloth_aside_is_dragged_towards_the_middle_by_its_foremost_point() -> None:
    mask = cloth_mask(picture(shifted(0.1, 0.0)))
    pull = centring_pull(mask, (42.0, 42.0))
    foremost = np.nonzero(mask)[1].min()
    assert pull.pick_px[0] == pytest.approx(foremost, abs=4)
    assert 5 < pull.pick_px[0] - pull.drop_px[0] < 0.1 * Camera().px_per_m
    assert pull.drop_px[1] == pytest.approx(pull.pick_px[1], abs=0.5)


def test_cloth_that_leaves_the_picture_is_told_from_cloth_within() -> None:
    assert not touches_border(cloth_mask(picture(SHEET.vertices_m)))
    assert touches_border(cloth_mask(picture(shifted(0.15, 0.0))))


@pytest.mark.parametrize(
    ("towards", "drop_px"), list(enumerate([(0.0, 0.0), (84.0, 0.0), (0.0, 84.0), (84.0, 84.0)]))
)
def test_turning_carries_the_farthest_end_to_a_corner_of_the_picture(
    towards: int, drop_px: tuple[float, float]
) -> None:
    pull = turning_pull(cloth_mask(picture(SHEET.vertices_m)), towards)
    assert pull.drop_px == drop_px
    half_px = 0.15 * Camera().px_per_m
    opposite_px = 42 - half_px * np.sign(np.array(drop_px) - 42)
    assert pull.pick_px == pytest.approx(opposite_px, abs=4)


def test_pictures_that_will_not_do_are_refused() -> None:
    for find in (
        lambda: spreading_pulls(EMPTY, 2000),
        lambda: turning_pull(cloth_mask(EMPTY), 0),
        lambda: centring_pull(cloth_mask(EMPTY), (42.0, 42.0)),
    ):
        with pytest.raises(NoClothInViewError, match="expected at least one pixel of cloth"):
            find()
    with pytest.raises(ValueError, match=r"picture: expected uint8 \[H, W, 3\]"):
        spreading_pulls(EMPTY[..., 0], 2000)
