import numpy as np
import pytest

from actors.cloth.gestures import (
    Gesture,
    GripperMotion,
    Hand,
    hand_paths_in_world,
    pick_and_drop,
    turns_in_world,
)

ONE = np.array([0])


def test_pick_and_drop_goes_up_across_and_down_at_its_speed() -> None:
    motion = GripperMotion(speed_m_per_s=0.5)
    vertices = np.array([[-0.1, 0.05, 0.003]])
    gesture = pick_and_drop(vertices, ONE, (0.12, -0.09), motion)
    path = hand_paths_in_world(vertices, gesture, 1 / 400)[:, 0, :3]
    steps_m = np.linalg.norm(np.diff(np.vstack([vertices, path]), axis=0), axis=1)
    assert steps_m.max() <= 0.5 / 400 + 1e-12
    np.testing.assert_allclose(path[-1], [0.12, -0.09, motion.release_height_m])
    assert path[:, 2].max() == pytest.approx(motion.lift_height_m)
    moved_across = np.abs(np.diff(path[:, 0])) > 1e-12
    assert (path[1:][moved_across][:, 2] == motion.lift_height_m).all()


def test_a_drop_right_above_the_pick_still_makes_a_path() -> None:
    vertices = np.array([[0.0, 0.0, 0.1]])
    path = hand_paths_in_world(vertices, pick_and_drop(vertices, ONE, (0.0, 0.0)), 1 / 400)
    assert np.isfinite(path).all()
    np.testing.assert_allclose(path[-1, 0], [0.0, 0.0, 0.03, 0.0])


def test_hands_pass_their_stations_at_the_same_times() -> None:
    near = Hand(ONE, np.array([[0.0, 0.0, 0.01], [0.0, 0.0, 0.02]]))
    far = Hand(np.array([1]), np.array([[0.5, 0.0, 0.1], [0.5, 0.0, 0.2]]))
    starts = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    gesture = Gesture((near, far), GripperMotion(speed_m_per_s=1.0))
    paths = hand_paths_in_world(starts, gesture, 1 / 100)
    assert paths.shape == (20, 2, 4)
    np.testing.assert_allclose(paths[9], [[0.0, 0.0, 0.01, 0.0], [0.5, 0.0, 0.1, 0.0]])
    np.testing.assert_allclose(paths[-1], [[0.0, 0.0, 0.02, 0.0], [0.5, 0.0, 0.2, 0.0]])
    np.testing.assert_allclose(paths[:, 0, 2], paths[:, 1, 2] / 10)


def test_a_hand_turns_what_it_holds_around_its_axis() -> None:
    turning = Hand(ONE, np.array([[0.0, 0.0, 0.1]]), np.array([np.pi / 2]), (0.0, 1.0, 0.0))
    paths = hand_paths_in_world(np.zeros((1, 3)), Gesture((turning,)), 1 / 100)
    np.testing.assert_allclose(paths[[4, -1], 0, 3], [np.pi / 4, np.pi / 2])
    (quarter,) = turns_in_world(turning, paths[-1:, 0, 3])
    np.testing.assert_allclose(quarter @ [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(quarter @ [0.0, 1.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)


def test_impossible_gestures_are_refused() -> None:
    one_station, two_stations = np.zeros((1, 3)), np.zeros((2, 3))
    with pytest.raises(ValueError, match="drop_xy_m: expected two finite numbers"):
        pick_and_drop(np.zeros((1, 3)), ONE, (float("inf"), 0.0))
    with pytest.raises(ValueError, match="expected ids from 0 to 0; got"):
        pick_and_drop(np.zeros((1, 3)), np.array([1]), (0.0, 0.0))
    with pytest.raises(ValueError, match=r"GripperMotion\.speed_m_per_s: expected a positive"):
        GripperMotion(speed_m_per_s=0.0)
    with pytest.raises(
        ValueError, match=r"expected hands with equally many stations; got \[1, 2\]"
    ):
        Gesture((Hand(ONE, one_station), Hand(ONE, two_stations)))
    with pytest.raises(ValueError, match=r"expected hands with equally many stations; got \[\]"):
        Gesture(())
    with pytest.raises(ValueError, match=r"stations_in_world: expected finite f64 \[W >= 1, 3\]"):
        Hand(ONE, np.zeros((0, 3)))
    with pytest.raises(ValueError, match=r"expected turns_rad f64 \[2\] .*; got \[1\] and 1"):
        Hand(ONE, two_stations, np.zeros(1))
    with pytest.raises(ValueError, match=r"around an axis of length 1; got .* and 2"):
        Hand(ONE, one_station, np.zeros(1), (2.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="no vertex for two hands"):
        Gesture((Hand(ONE, one_station), Hand(ONE, one_station))).check(5)
