import numpy as np
import pytest

from actors.cloth.grasps import check_grasp, grasped_vertices, pinched_vertices
from actors.cloth.meshes import rectangular_sheet


def test_from_above_only_the_top_layer_is_grasped() -> None:
    bottom = rectangular_sheet(12, 0.3).vertices_m
    top = bottom + np.array([0.01, 0.0, 0.02])
    grasped = grasped_vertices(np.concatenate([bottom, top]), (0.0, 0.0))
    assert (grasped >= len(bottom)).all()
    assert 1 <= len(grasped) <= 4


def test_around_the_edge_all_layers_are_grasped() -> None:
    bottom = rectangular_sheet(12, 0.3).vertices_m
    vertices = np.concatenate([bottom, bottom + np.array([0.0, 0.0, 0.02])])
    pinched = pinched_vertices(vertices, (0.15, 0.15))
    assert sorted(pinched.tolist()) == [143, 287]
    assert pinched_vertices(vertices, (0.4, 0.4)).tolist() == [143, 287]


def test_beside_the_cloth_the_nearest_vertex_is_grasped_first() -> None:
    vertices = rectangular_sheet(12, 0.3).vertices_m
    grasped = grasped_vertices(vertices, (0.4, 0.4))
    np.testing.assert_allclose(vertices[grasped[0], :2], [0.15, 0.15])


def test_a_covered_vertex_does_not_hide_the_layer_above_it() -> None:
    vertices = np.array([[0.0, 0.0, 0.003], [0.025, 0.0, 0.03]])
    assert grasped_vertices(vertices, (0.0, 0.0)).tolist() == [0]
    assert grasped_vertices(vertices, (0.01, 0.0)).tolist() == [1]


@pytest.mark.parametrize("ids", [[], [3, 3], [-1], [144]])
def test_impossible_grasps_are_refused(ids: list[int]) -> None:
    with pytest.raises(ValueError, match="grasped vertices: expected"):
        check_grasp(np.array(ids, dtype=np.int64), 144)
