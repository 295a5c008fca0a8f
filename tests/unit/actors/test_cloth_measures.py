import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.cloth.camera import Camera
from actors.cloth.garments import make_garment
from actors.cloth.masks import cloth_mask
from actors.cloth.measures import (
    aligned_iou,
    coverage_m2,
    iou,
    mean_particle_distance_m,
    normalised_coverage,
    normalised_performance,
    true_coverage,
)
from actors.cloth.rasteriser import draw_cloth

SHIRT = make_garment("shirt", spacing_m=0.02)
SQUARE = make_garment("handkerchief", spacing_m=0.03)
CAMERA = Camera(view_half_width_m=0.35)


def _moved(vertices: np.ndarray, turn_rad: float, x_m: float, y_m: float) -> np.ndarray:
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    moved = vertices.copy()
    moved[:, :2] = vertices[:, :2] @ np.array([[cosine, sine], [-sine, cosine]]) + [x_m, y_m]
    return moved


def _left_folded(garment_vertices: np.ndarray) -> np.ndarray:
    folded = garment_vertices.copy()
    beyond = folded[:, 0] < -0.05
    folded[beyond, 0] = -0.1 - folded[beyond, 0]
    folded[beyond, 2] += 0.01
    return folded


def _mask(vertices: np.ndarray) -> np.ndarray:
    return cloth_mask(draw_cloth(vertices, SHIRT.mesh.faces, CAMERA))


def test_coverage_is_an_area_and_a_portion_of_the_flat_one() -> None:
    mask = np.zeros((10, 10), bool)
    mask[2:6, 2:7] = True
    assert coverage_m2(mask, px_per_m=100.0) == pytest.approx(0.002)
    assert normalised_coverage(mask, flat_px=40) == 0.5
    with pytest.raises(ValueError, match="flat_px: expected the pixels of the flat garment"):
        normalised_coverage(mask, 0)


def test_true_coverage_knows_neither_camera_nor_height() -> None:
    vertices = SQUARE.mesh.vertices_m
    aside = _moved(vertices, 0.3, 0.35, 0.0)
    assert true_coverage(aside, SQUARE) == pytest.approx(1.0, abs=0.01)
    raised = vertices + np.array([0.0, 0.0, 0.1])
    assert true_coverage(raised, SQUARE) == pytest.approx(1.0, abs=0.02)
    halved = np.where(vertices[:, :1] > 0.0, vertices * [-1.0, 1.0, 1.0], vertices)
    assert true_coverage(halved, SQUARE) == pytest.approx(0.5, abs=0.01)


def test_performance_is_0_at_the_start_and_1_at_best() -> None:
    assert normalised_performance(3.0, 3.0, 5.0) == 0.0
    assert normalised_performance(5.0, 3.0, 5.0) == 1.0
    assert normalised_performance(2.0, 3.0, 5.0) == -0.5
    with pytest.raises(ValueError, match="expected a best value apart from the start's"):
        normalised_performance(2.0, 3.0, 3.0)


def test_iou_counts_pixels() -> None:
    one, two = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert iou(one, two) == 1.0
    one[:2], two[1:3] = True, True
    assert iou(one, two) == pytest.approx(4 / 12)
    assert aligned_iou(one, np.zeros((4, 4), bool)) == 0.0


@settings(deadline=None, max_examples=20)
@given(st.floats(-3.1, 3.1), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
def test_moving_and_turning_changes_neither_measure(turn: float, x_m: float, y_m: float) -> None:
    folded = _left_folded(SHIRT.mesh.vertices_m)
    moved = _moved(folded, turn, x_m, y_m)
    assert mean_particle_distance_m(moved, folded, SHIRT) < 1e-9
    assert aligned_iou(_mask(moved), _mask(folded)) > 0.93


def test_either_side_may_be_folded_first_where_left_and_right_are_alike() -> None:
    left = _left_folded(SHIRT.mesh.vertices_m)
    right = _left_folded(SHIRT.mesh.vertices_m[SHIRT.symmetries[1].order] * [-1, 1, 1])
    right = right[SHIRT.symmetries[1].order] * [-1.0, 1.0, 1.0]
    assert right[:, 0].min() < -0.2 < 0.2 > right[:, 0].max()
    assert mean_particle_distance_m(right, left, SHIRT) < 1e-9
    assert aligned_iou(_mask(right), _mask(left)) < 0.9
    assert aligned_iou(_mask(right), _mask(left), may_mirror=True) > 0.95


def test_quarter_turns_of_a_square_are_the_same_square_but_its_other_side_is_not() -> None:
    flat = SQUARE.mesh.vertices_m
    assert mean_particle_distance_m(_moved(flat, np.pi / 2, 0, 0), flat, SQUARE) < 1e-9
    corner_folded = flat.copy()
    beyond = corner_folded[:, 0] + corner_folded[:, 1] > 0.15
    corner_folded[beyond, :2] = 0.15 - corner_folded[beyond, 1::-1]
    other = np.stack([-corner_folded[:, 1], corner_folded[:, 0], corner_folded[:, 2]], axis=1)
    named = other[SQUARE.symmetries[1].order]
    assert mean_particle_distance_m(named, corner_folded, SQUARE) < 1e-9


def test_unfolded_is_far_from_folded() -> None:
    flat = SHIRT.mesh.vertices_m
    distance_m = mean_particle_distance_m(flat, _left_folded(flat), SHIRT)
    assert 0.02 < distance_m < 0.1
