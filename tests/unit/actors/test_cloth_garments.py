from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.cloth.garments import (
    GARMENT_KINDS,
    Garment,
    GarmentKind,
    garment_from_obj,
    make_garment,
)
from actors.cloth.obj_files import read_obj, write_obj
from actors.cloth.outlines import TSHIRT, ShirtSizes, TrousersSizes
from actors.cloth.triangulation import triangulated

SPREAD_OUT = [TSHIRT, ShirtSizes(), TrousersSizes()]


def _twice_areas_m2(garment: Garment) -> np.ndarray:
    a, b, c = (garment.mesh.vertices_m[garment.mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)[:, 2]


def _area_m2(corners: np.ndarray) -> float:
    x, y = corners.T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


@pytest.mark.parametrize("kind", GARMENT_KINDS)
def test_a_garment_is_one_good_layer_of_some_hundred_vertices(
    kind: GarmentKind, tmp_path: Path
) -> None:
    garment = make_garment(kind)
    assert 300 < len(garment.mesh.vertices_m) < 600
    assert (_twice_areas_m2(garment) > 0).all()
    write_obj(garment.mesh, tmp_path / "garment.obj")
    read_obj(tmp_path / "garment.obj")  # refuses what is not manifold or badly shaped
    assert len(make_garment(kind, spacing_m=0.03).mesh.vertices_m) < 160


@pytest.mark.parametrize("sizes", SPREAD_OUT)
def test_triangles_fill_the_outline_and_follow_it(sizes: ShirtSizes | TrousersSizes) -> None:
    outline = sizes.outline()
    mesh = triangulated(outline, 0.02)
    garment = Garment("any", mesh)
    assert _twice_areas_m2(garment).sum() / 2 == pytest.approx(
        _area_m2(outline.corners_m), rel=0.01
    )
    for corner in outline.corners_m:
        assert np.linalg.norm(mesh.vertices_m[:, :2] - corner, axis=1).min() < 1e-9


def test_most_of_a_garment_is_a_grid_with_alternating_diagonals() -> None:
    mesh = make_garment("shirt", spacing_m=0.02).mesh
    inner = np.abs(mesh.vertices_m[:, 0]) < 0.065
    inner &= np.abs(mesh.vertices_m[:, 1]) < 0.1
    degrees = np.bincount(mesh.edges.reshape(-1))[inner]
    assert set(degrees.tolist()) == {4, 8}


@pytest.mark.parametrize("kind", GARMENT_KINDS)
def test_keypoints_lie_where_they_are_named(kind: GarmentKind) -> None:
    garment = make_garment(kind)
    for name, vertex in garment.keypoints.items():
        x_m, y_m, _ = garment.mesh.vertices_m[vertex]
        if "left" in name:
            assert x_m < -0.03, name
        if "right" in name:
            assert x_m > 0.03, name
        if "hem" in name or "lower" in name:
            assert y_m < -0.14, name
        if name.startswith(("shoulder", "waist", "collar")):
            assert y_m > 0.14, name


def test_symmetries_are_those_of_the_shape() -> None:
    square = make_garment("handkerchief").symmetries
    assert sorted(symmetry.mirrored for symmetry in square) == [False] * 4 + [True] * 4
    for kind in ("tshirt", "shirt", "trousers"):
        garment = make_garment(kind)  # type: ignore[arg-type]
        identity, mirror = garment.symmetries
        assert not identity.mirrored
        assert (identity.order == np.arange(len(identity.order))).all()
        assert mirror.mirrored
        left, right = garment.keypoints["hem_left"], garment.keypoints["hem_right"]
        assert mirror.order[left] == right


@settings(max_examples=20)
@given(
    st.floats(0.7, 1.3), st.floats(0.8, 1.2), st.floats(0.7, 1.4), st.floats(0.1, 0.95),
    st.floats(0.6, 1.3),
)  # fmt: skip
def test_other_sizes_make_good_garments_too(
    width: float, length: float, sleeve: float, angle_rad: float, scale: float
) -> None:
    sizes = {
        "body_width_m": 0.22 * width * scale,
        "body_length_m": 0.40 * length * scale,
        "shoulder_width_m": 0.20 * width * scale,
        "neck_width_m": 0.09 * width * scale,
        "sleeve_length_m": 0.20 * sleeve * scale,
        "sleeve_width_m": 0.075 * scale,
        "sleeve_angle_rad": angle_rad,
    }
    garment = make_garment("shirt", sizes=sizes)
    assert (_twice_areas_m2(garment) > 0).all()
    edges_m = garment.mesh.rest_edge_lengths_m
    assert edges_m.max() < 2.2 * 0.015
    assert edges_m.min() > 0.3 * 0.015
    assert len(garment.symmetries) == 2


@pytest.mark.parametrize(
    ("kind", "sizes", "complaint"),
    [
        ("gloves", {}, "garment: expected one of handkerchief, tshirt"),
        ("shirt", {"collar_m": 0.1}, "sizes: expected some of body_width_m"),
        ("shirt", {"body_width_m": 0.0}, "ShirtSizes.body_width_m: expected 0.005 to 1 m; got 0"),
        ("shirt", {"neck_width_m": 0.3}, "expected neck_width_m < shoulder_width_m"),
        ("shirt", {"sleeve_angle_rad": 1.5}, "sleeve_angle_rad: expected -0.2 to 1.2"),
        ("shirt", {"sleeve_width_m": 0.5}, "expected armpits above the hem"),
        ("shirt", {"sleeve_length_m": 0.01}, "expected sleeves that reach beyond the body"),
        ("trousers", {"leg_width_m": 0.2}, "the legs would cross"),
        ("trousers", {"leg_length_m": 0.47}, "nothing would join the legs"),
        ("handkerchief", {"side_m": 2.0}, "HandkerchiefSizes.side_m: expected 0.005 to 1 m"),
    ],
)
def test_impossible_garments_are_refused(
    kind: GarmentKind, sizes: dict[str, float], complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        make_garment(kind, sizes=sizes)


def test_a_spacing_too_large_for_the_outline_is_refused() -> None:
    with pytest.raises(ValueError, match="expected triangles that fill the outline"):
        make_garment("shirt", spacing_m=0.3)
    with pytest.raises(ValueError, match="spacing_m: expected a positive length"):
        make_garment("shirt", spacing_m=0.0)


def test_a_users_garment_has_the_keypoints_that_were_given(tmp_path: Path) -> None:
    path = tmp_path / "napkin.obj"
    write_obj(make_garment("handkerchief").mesh, path)
    garment = garment_from_obj(path, keypoints_m={"corner": (0.15, 0.15)})
    assert garment.name == "napkin"
    np.testing.assert_allclose(
        garment.mesh.vertices_m[garment.keypoints["corner"]], [0.15, 0.15, 0.0]
    )
    assert len(garment.symmetries) == 8
