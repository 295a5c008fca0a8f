"""Where links are and how far apart, against PyBullet; which angles bring the fingers somewhere."""

from collections.abc import Iterator

import numpy as np
import pytest

from actors.cloth.camera import Camera
from actors.cloth.quiet_pybullet import pybullet
from actors.robot.body import RobotBody
from actors.robot.clearance import FAR_M, are_neighbours, dense, least_clearances_m
from actors.robot.inverse_kinematics import (
    LOWER_RAD,
    MOST_TILT_RAD,
    POSITION_TOLERANCE_M,
    UPPER_RAD,
    Solution,
    solve,
)
from actors.robot.kinematics import HANDS, fingertips_in_robot, link_frames
from actors.robot.model import (
    ARMS,
    INITIAL_POSE_RAD,
    JOINTS,
    WITHDRAWN_POSE_RAD,
    arm_joints,
)
from actors.robot.pictures import robot_figure
from actors.robot.stances import STANCES, Stance

INITIAL, WITHDRAWN = np.array(INITIAL_POSE_RAD), np.array(WITHDRAWN_POSE_RAD)


@pytest.fixture
def client() -> Iterator[int]:
    client = pybullet.connect(pybullet.DIRECT)
    yield client
    pybullet.disconnect(physicsClientId=client)


def poses(n: int) -> np.ndarray:
    """Random ones, from near the initial one to anywhere within limits."""
    random = np.random.default_rng(0)
    anywhere = random.uniform(LOWER_RAD, UPPER_RAD, (n, len(JOINTS)))
    return INITIAL + np.linspace(0.1, 1.0, n)[:, None] * (anywhere - INITIAL)


@pytest.mark.parametrize("stance", STANCES.values())
def test_fingers_are_where_pybullet_has_them(client: int, stance: Stance) -> None:
    body = RobotBody(client, stance)
    for joints in poses(10):
        body.pose(joints)
        for arm in ARMS:
            (tip,) = stance.in_world(fingertips_in_robot(joints[None], arm))
            np.testing.assert_allclose(tip, body.fingers_in_world(arm), atol=1e-5)
            np.testing.assert_allclose(stance.in_world(stance.in_robot(tip)), tip, atol=1e-12)


def test_clearances_are_those_that_pybullet_finds(client: int) -> None:
    stance = STANCES["front"]
    body = RobotBody(client, stance)
    half = [2.0, 2.0, 0.05]
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client
    )
    table = pybullet.createMultiBody(0, shape, -1, [0.0, 0.0, -0.05], physicsClientId=client)
    link_of = {pybullets: link for link, pybullets in enumerate(body.links)}
    arms_but_hands = {link for arm in ARMS for link in arm_joints(arm)[:-1]}
    n_touching = 0
    for joints in poses(16):
        body.pose(joints)
        found = pybullet.getClosestPoints(body.body_id, body.body_id, 0.06, physicsClientId=client)
        apart = [
            point[8]
            for point in found
            if point[3] != point[4] and not are_neighbours(link_of[point[3]], link_of[point[4]])
        ]
        own_m, above_table_m = least_clearances_m(joints[None], -stance.z_m)
        n_touching += own_m < 0.0
        if own_m > 0.0:  # PyBullet's depth of two bodies in each other is another measure
            assert own_m == pytest.approx(min([*apart, FAR_M]), abs=1e-3)
        else:
            assert min(apart) < 1e-3
        found = pybullet.getClosestPoints(body.body_id, table, 3.0, physicsClientId=client)
        above = min(point[8] for point in found if link_of[point[3]] in arms_but_hands)
        if above_table_m > 0.0:
            assert above_table_m == pytest.approx(above, abs=1e-3)
    assert 0 < n_touching < 16


def test_a_dense_way_leaves_out_no_row_and_no_move_larger_than_its_step() -> None:
    way = poses(5)
    rows = dense(way, 0.05)
    assert np.abs(np.diff(rows, axis=0)).max() <= 0.05 + 1e-12
    for row in way:
        assert np.abs(rows - row).max(axis=1).min() < 1e-12
    standing = dense(np.stack([INITIAL, INITIAL]), 0.05)
    np.testing.assert_array_equal(standing, [INITIAL, INITIAL])


def test_the_initial_pose_is_the_robot_s_and_its_hands_point_down() -> None:
    rotations, _ = link_frames(INITIAL)
    assert (rotations[HANDS, 2, 0] > 0.99).all()
    right_deg = [-0.6, 0.0, -100.0, 15.2, 9.4, 3.2]
    np.testing.assert_allclose(np.rad2deg(INITIAL[arm_joints("right")]), right_deg)
    assert ((LOWER_RAD < INITIAL) & (INITIAL < UPPER_RAD)).all()


@pytest.mark.parametrize("stance", STANCES.values())
def test_withdrawn_arms_are_clear_and_out_of_the_picture(stance: Stance) -> None:
    assert min(least_clearances_m(WITHDRAWN[None], -stance.z_m)) > 0.02
    assert ((LOWER_RAD < WITHDRAWN) & (WITHDRAWN < UPPER_RAD)).all()
    camera = Camera()
    seen_px = camera.project_px(robot_figure(WITHDRAWN, stance).vertices_m)
    assert not ((seen_px > 0) & (seen_px < camera.size_px)).all(axis=1).any()


@pytest.mark.parametrize("arms", [("left",), ("right",), ("left", "right"), ("right", "left")])
def test_fingers_come_to_points_and_keep_down_and_their_heading(arms) -> None:
    points = np.array([[0.33, 0.12 if arms[0] == "left" else -0.12, -0.04], [0.38, 0.0, 0.02]])
    points[1, 1] = -points[0, 1]
    joints = INITIAL.copy()
    assert solve(joints, arms, points[: len(arms)]) is Solution.FOUND
    assert ((joints >= LOWER_RAD) & (joints <= UPPER_RAD)).all()
    rotations, _ = link_frames(joints)
    for arm, point in zip(arms, points, strict=False):
        (tip,) = fingertips_in_robot(joints[None], arm)
        assert np.linalg.norm(tip - point) < POSITION_TOLERANCE_M
        hand = rotations[HANDS[ARMS.index(arm)]]
        assert hand[2, 0] > np.cos(MOST_TILT_RAD)
        assert abs(hand[0, 1]) < np.sin(MOST_TILT_RAD)  # fingers open along the robot's y
        assert hand[1, 1] > 0.9
    idle = set(ARMS) - set(arms)
    for arm in idle:
        np.testing.assert_array_equal(joints[arm_joints(arm)], INITIAL[arm_joints(arm)])


def test_what_cannot_be_solved_says_why() -> None:
    assert solve(INITIAL.copy(), ("left",), np.array([[0.9, 0.0, 0.0]])) is Solution.NONE
    behind = solve(INITIAL.copy(), ("left", "right"), np.array([[0.06, 0.1, 0.0], [0.06, -0.1, 0]]))
    assert behind is Solution.BEYOND_LIMITS
