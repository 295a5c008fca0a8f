from collections.abc import Iterator

import numpy as np
import pytest

from actors.cloth.camera import Camera
from actors.cloth.fold_lines import fold, plan_fold
from actors.cloth.garments import make_garment
from actors.cloth.gestures import Gesture, Hand, pick_and_drop
from actors.cloth.masks import cloth_mask
from actors.cloth.quiet_pybullet import pybullet
from actors.cloth.rasteriser import draw_cloth
from actors.robot.body import RobotBody
from actors.robot.model import ARMS, INITIAL_POSE_RAD, JOINTS, SPEED_RAD_PER_S, arm_joints
from actors.robot.planning import (
    MOST_TILT_RAD,
    POSITION_TOLERANCE_M,
    ArmPlanner,
    Obstacle,
    UnreachableError,
)

LOWER = np.array([joint.lower_rad for joint in JOINTS])
UPPER = np.array([joint.upper_rad for joint in JOINTS])
ONE = np.array([0])


@pytest.fixture
def client() -> Iterator[int]:
    client = pybullet.connect(pybullet.DIRECT)
    yield client
    pybullet.disconnect(physicsClientId=client)


@pytest.fixture
def body(client: int) -> RobotBody:
    return RobotBody(client)


def planner_over_table(client: int, body: RobotBody, top_m: float) -> ArmPlanner:
    box = pybullet.createCollisionShape(
        pybullet.GEOM_BOX, halfExtents=[0.6, 0.4, 0.05], physicsClientId=client
    )
    table = pybullet.createMultiBody(0, box, -1, [0.0, 0.25, top_m - 0.05], physicsClientId=client)
    return ArmPlanner(body, table)


@pytest.fixture
def planner(client: int, body: RobotBody) -> ArmPlanner:
    return planner_over_table(client, body, top_m=0.0)


def test_in_its_initial_pose_both_hands_point_down_at_the_table(body: RobotBody) -> None:
    left, right = (body.fingers(arm) for arm in ARMS)
    for fingers in (left, right):
        assert fingers.direction_in_world @ [0.0, 0.0, -1.0] > 0.99
        assert 0.0 < fingers.position_in_world[2] < 0.15
    np.testing.assert_allclose(
        left.position_in_world, right.position_in_world * [-1.0, 1.0, 1.0], atol=1e-3
    )
    assert left.position_in_world[0] < -0.1
    assert all(body.self_distance_m(arm) > 0.005 for arm in ARMS)
    assert ((np.array(INITIAL_POSE_RAD) > LOWER) & (np.array(INITIAL_POSE_RAD) < UPPER)).all()


@pytest.mark.parametrize("arm", ARMS)
def test_the_jacobian_is_the_change_of_position_with_the_joints(body: RobotBody, arm) -> None:
    joints = body.joints_rad + np.linspace(-0.2, 0.2, 15)
    body.pose(joints)
    fingers, numeric = body.fingers(arm), np.zeros((3, 6))
    for column, joint in enumerate(arm_joints(arm)):
        moved = joints.copy()
        moved[joint] += 1e-3
        body.pose(moved)
        change = body.fingers(arm).position_in_world - fingers.position_in_world
        numeric[:, column] = change / 1e-3
    np.testing.assert_allclose(fingers.jacobian[:3], numeric, atol=2e-3)


def test_most_of_the_handkerchiefs_table_is_within_reach(planner: ArmPlanner) -> None:
    places = [(x, y) for x in np.linspace(-0.2, 0.2, 5) for y in np.linspace(-0.15, 0.1, 6)]
    reached = [planner.reaches((x, y, 0.02)) is None for x, y in places]
    assert np.mean(reached) > 0.9


def test_what_is_out_of_reach_says_why(planner: ArmPlanner, client: int, body: RobotBody) -> None:
    assert planner.reaches((0.0, 0.6, 0.02)) is Obstacle.OUT_OF_REACH
    high = planner_over_table(client, body, top_m=0.2)
    assert high.reaches((-0.15, 0.05, 0.02)) is Obstacle.TABLE


def test_a_planned_pick_and_drop_follows_its_way_within_all_limits(
    planner: ArmPlanner, body: RobotBody
) -> None:
    start = np.array([[-0.12, 0.05, 0.006]])
    gesture = pick_and_drop(start, ONE, (0.05, -0.06))
    plan = planner.plan(start, gesture)
    assert plan.arms == ("left",)
    assert ((plan.joints_rad >= LOWER - 1e-9) & (plan.joints_rad <= UPPER + 1e-9)).all()
    speeds = np.abs(np.diff(plan.joints_rad, axis=0)) / np.diff(plan.times_secs)[:, None]
    assert speeds.max() <= SPEED_RAD_PER_S + 1e-9
    assert np.abs(np.diff(plan.joints_rad[1:], axis=0)).max() < 0.4
    for row, expected in (
        (plan.closes_at, start[0]),
        (plan.opens_at, gesture.hands[0].stations_in_world[-1]),
    ):
        body.pose(plan.joints_rad[row])
        fingers = body.fingers("left")
        assert np.linalg.norm(fingers.position_in_world - expected) < POSITION_TOLERANCE_M
        assert fingers.direction_in_world @ [0.0, 0.0, -1.0] > np.cos(MOST_TILT_RAD)


def test_two_arms_fold_trousers(planner: ArmPlanner) -> None:
    garment = make_garment("trousers", sizes={"length_m": 0.26, "leg_length_m": 0.16})
    camera, vertices = Camera(view_half_width_m=0.3), garment.mesh.vertices_m
    mask = cloth_mask(draw_cloth(vertices, garment.mesh.faces, camera))
    gesture = fold(vertices, plan_fold(mask, camera, 4))
    starts = np.stack([vertices[hand.grasped[0]] for hand in gesture.hands])
    plan = planner.plan(starts, gesture)
    left_first = starts[0, 0] < starts[1, 0]
    assert plan.arms == (("left", "right") if left_first else ("right", "left"))


def test_gestures_that_cannot_be_made_are_refused(planner: ArmPlanner) -> None:
    starts = np.array([[-0.1, 0.0, 0.01], [-0.08, 0.0, 0.01], [0.1, 0.0, 0.01]])
    hands = tuple(Hand(ONE + k, start[None] + 0.05) for k, start in enumerate(starts))
    with pytest.raises(UnreachableError, match="3 hands for two arms") as refusal:
        planner.plan(starts, Gesture(hands))
    assert refusal.value.obstacle is Obstacle.TOO_MANY_HANDS
    with pytest.raises(UnreachableError, match=r"hands 0\.020 m apart"):
        planner.plan(starts[:2], Gesture(hands[:2]))
    with pytest.raises(UnreachableError, match=r"the left hand at \(.*\) m \(out_of_reach\)"):
        planner.plan(starts[:1], pick_and_drop(starts, ONE, (0.0, 0.5)))
