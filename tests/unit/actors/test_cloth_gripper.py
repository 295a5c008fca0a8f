import numpy as np
import pytest

from actors.cloth.gripper import (
    GripperMotion,
    check_drop,
    check_grasp,
    grasped_vertices,
    gripper_path_in_world,
)
from actors.cloth.meshes import rectangular_sheet


def test_the_path_goes_up_across_and_down_at_its_speed() -> None:
    motion = GripperMotion(speed_m_per_s=0.5)
    start = np.array([-0.1, 0.05, 0.003])
    path = gripper_path_in_world(start, (0.12, -0.09), motion, 1 / 400)
    steps_m = np.linalg.norm(np.diff(np.vstack([start, path]), axis=0), axis=1)
    assert steps_m.max() <= 0.5 / 400 + 1e-12
    np.testing.assert_allclose(path[-1], [0.12, -0.09, motion.release_height_m])
    assert path[:, 2].max() == pytest.approx(motion.lift_height_m)
    moved_across = np.abs(np.diff(path[:, 0])) > 1e-12
    assert (path[1:][moved_across][:, 2] == motion.lift_height_m).all()


def test_a_drop_right_above_the_pick_still_makes_a_path() -> None:
    start = np.array([0.0, 0.0, 0.1])
    path = gripper_path_in_world(start, (0.0, 0.0), GripperMotion(), 1 / 400)
    assert np.isfinite(path).all()
    np.testing.assert_allclose(path[-1], [0.0, 0.0, 0.03])


def test_only_the_top_layer_is_grasped() -> None:
    bottom = rectangular_sheet(12, 0.3).vertices_m
    top = bottom + np.array([0.01, 0.0, 0.02])
    grasped = grasped_vertices(np.concatenate([bottom, top]), (0.0, 0.0))
    assert (grasped >= len(bottom)).all()
    assert 1 <= len(grasped) <= 4


def test_beside_the_cloth_the_nearest_vertex_is_grasped_first() -> None:
    vertices = rectangular_sheet(12, 0.3).vertices_m
    grasped = grasped_vertices(vertices, (0.4, 0.4))
    np.testing.assert_allclose(vertices[grasped[0], :2], [0.15, 0.15])


def test_a_covered_vertex_does_not_hide_the_layer_above_it() -> None:
    vertices = np.array([[0.0, 0.0, 0.003], [0.025, 0.0, 0.03]])
    assert grasped_vertices(vertices, (0.0, 0.0)).tolist() == [0]
    assert grasped_vertices(vertices, (0.01, 0.0)).tolist() == [1]


@pytest.mark.parametrize("ids", [[], [0, 1, 2, 3, 4], [3, 3], [-1], [144]])
def test_impossible_grasps_are_refused(ids: list[int]) -> None:
    with pytest.raises(ValueError, match="grasped vertices: expected"):
        check_grasp(np.array(ids, dtype=np.int64), 144)


def test_an_impossible_drop_is_refused() -> None:
    with pytest.raises(ValueError, match="drop_xy_m: expected two finite numbers"):
        check_drop((float("inf"), 0.0))


def test_an_impossible_motion_is_refused() -> None:
    with pytest.raises(ValueError, match=r"GripperMotion\.speed_m_per_s: expected a positive"):
        GripperMotion(speed_m_per_s=0.0)
