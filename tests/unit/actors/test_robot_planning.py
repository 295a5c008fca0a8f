"""Plans for gestures: each is looked at as a whole, by PyBullet too."""

from collections.abc import Iterator

import numpy as np
import pytest

from actors.cloth.camera import Camera
from actors.cloth.fold_lines import fold, plan_fold
from actors.cloth.garments import make_garment
from actors.cloth.gestures import Gesture, Hand, hand_paths_in_world, pick_and_drop
from actors.cloth.masks import cloth_mask
from actors.cloth.quiet_pybullet import pybullet
from actors.cloth.rasteriser import draw_cloth
from actors.robot.body import RobotBody
from actors.robot.clearance import are_neighbours, dense
from actors.robot.inverse_kinematics import (
    LOWER_RAD,
    MOST_TILT_RAD,
    POSITION_TOLERANCE_M,
    UPPER_RAD,
)
from actors.robot.kinematics import HANDS, link_frames
from actors.robot.model import (
    ARMS,
    CHEST_JOINT,
    SPEED_RAD_PER_S,
    WITHDRAWN_POSE_RAD,
    arm_joints,
)
from actors.robot.motion import MotionPlan
from actors.robot.planning import (
    LEAST_CLEARANCE_M,
    LEAST_HOVER_M,
    MOST_DETOUR_M,
    ArmPlanner,
    Obstacle,
    UnreachableError,
)
from actors.robot.stances import STANCES, Stance, check_stance

ONE = np.array([0])
FRONT = STANCES["front"]


@pytest.fixture
def client() -> Iterator[int]:
    client = pybullet.connect(pybullet.DIRECT)
    yield client
    pybullet.disconnect(physicsClientId=client)


def carry() -> tuple[np.ndarray, Gesture]:
    start = np.array([[-0.12, 0.05, 0.006]])
    return start, pick_and_drop(start, ONE, (0.1, -0.06))


def fold_along(kind, line: int) -> tuple[np.ndarray, Gesture]:
    garment, camera = make_garment(kind), Camera(view_half_width_m=0.32)
    vertices = garment.mesh.vertices_m
    mask = cloth_mask(draw_cloth(vertices, garment.mesh.faces, camera))
    return vertices, fold(vertices, plan_fold(mask, camera, line))


def starts_of(vertices: np.ndarray, gesture: Gesture) -> np.ndarray:
    return np.stack([vertices[hand.grasped[0]] for hand in gesture.hands])


PLANNED = {
    "carry": (carry, FRONT),
    "shirt, lower half up": (lambda: fold_along("shirt", 4), FRONT),
    "trousers, left over right": (lambda: fold_along("trousers", 1), FRONT),
    "handkerchief, left over right": (lambda: fold_along("handkerchief", 1), STANCES["left"]),
}


@pytest.fixture(params=PLANNED)
def planned(request) -> tuple[np.ndarray, Gesture, MotionPlan]:
    make, stance = PLANNED[request.param]
    vertices, gesture = make()
    return vertices, gesture, ArmPlanner(stance).plan(vertices, gesture)


def test_a_plan_keeps_all_limits(planned) -> None:
    _, _, plan = planned
    assert ((plan.joints_rad >= LOWER_RAD) & (plan.joints_rad <= UPPER_RAD)).all()
    speeds = np.abs(np.diff(plan.joints_rad, axis=0)) / np.diff(plan.times_secs)[:, None]
    assert speeds.max() <= SPEED_RAD_PER_S + 1e-9
    for end in (0, -1):
        np.testing.assert_array_equal(plan.joints_rad[end], WITHDRAWN_POSE_RAD)
    for row in plan.joints_rad[1:-1]:
        rotations, _ = link_frames(row)
        for arm in plan.arms:
            assert rotations[HANDS[ARMS.index(arm)], 2, 0] > np.cos(MOST_TILT_RAD)


def test_pybullet_finds_no_collision_on_the_whole_way(planned, client: int) -> None:
    _, _, plan = planned
    body = RobotBody(client, plan.stance)
    link_of = {pybullets: link for link, pybullets in enumerate(body.links)}
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_BOX, halfExtents=[0.6, 0.6, 0.05], physicsClientId=client
    )
    table = pybullet.createMultiBody(0, shape, -1, [0.0, 0.0, -0.05], physicsClientId=client)
    hands = set(HANDS.tolist())
    for joints in dense(plan.joints_rad, 0.2):
        body.pose(joints)
        found = pybullet.getClosestPoints(
            body.body_id, body.body_id, LEAST_CLEARANCE_M, physicsClientId=client
        )
        pairs = {(link_of[point[3]], link_of[point[4]]) for point in found if point[8] < 0.009}
        assert all(one == two or are_neighbours(one, two) for one, two in pairs)
        near = pybullet.getClosestPoints(
            body.body_id, table, LEAST_CLEARANCE_M, physicsClientId=client
        )
        assert {link_of[point[3]] for point in near if point[8] < 0.009} <= hands


def test_fingers_close_pass_and_open_where_the_gesture_says(planned) -> None:
    vertices, gesture, plan = planned
    starts = starts_of(vertices, gesture)
    stations = np.stack([hand.stations_in_world for hand in gesture.hands], axis=1)
    rows = plan.fingers_in_world(plan.times_secs)
    assert np.linalg.norm(rows[plan.closes_at] - starts, axis=1).max() < POSITION_TOLERANCE_M
    assert np.linalg.norm(rows[plan.opens_at] - stations[-1], axis=1).max() < POSITION_TOLERANCE_M
    for station in stations:
        missed_m = np.linalg.norm(rows - station, axis=2).max(axis=1).min()
        assert missed_m < POSITION_TOLERANCE_M
    times = np.linspace(plan.closes_secs, plan.opens_secs, 200)
    ideal = hand_paths_in_world(starts, gesture, 0.002)[..., :3]
    for index in range(len(gesture.hands)):
        actual = plan.fingers_in_world(times)[:, index]
        off_m = np.linalg.norm(actual[:, None] - ideal[None, :, index], axis=2).min(axis=1)
        assert off_m.max() < MOST_DETOUR_M


def test_grippers_hover_on_their_way_to_the_cloth_and_back(planned) -> None:
    _, _, plan = planned
    for begin, end in ((0, 1), (-2, -1)):
        times = np.linspace(plan.times_secs[begin], plan.times_secs[end], 30)
        assert plan.fingers_in_world(times)[..., 2].min() > LEAST_HOVER_M


def test_equal_questions_get_equal_plans_and_only_arms_in_use_move() -> None:
    vertices, gesture = carry()
    one, two = (ArmPlanner(FRONT).plan(vertices, gesture) for _ in range(2))
    np.testing.assert_array_equal(one.joints_rad, two.joints_rad)
    assert one.arms == ("left",)
    assert (np.ptp(one.joints_rad, axis=0)[arm_joints("right")] == 0.0).all()


def test_the_chest_makes_folds_possible_that_the_arms_alone_cannot_make(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vertices, gesture = fold_along("trousers", 1)
    plan = ArmPlanner(FRONT).plan(vertices, gesture)
    assert np.abs(plan.joints_rad[:, CHEST_JOINT]).max() > 0.2
    for name, limits in (("LOWER_RAD", LOWER_RAD), ("UPPER_RAD", UPPER_RAD)):
        held = limits.copy()
        held[CHEST_JOINT] = 0.0
        monkeypatch.setattr(f"actors.robot.inverse_kinematics.{name}", held)
    monkeypatch.setattr("actors.robot.planning.CHEST_BEGINS_RAD", (0.0,))
    assert ArmPlanner(FRONT).obstacle(vertices, gesture) is not None


def test_the_natural_arm_is_taken_and_two_arms_fold() -> None:
    vertices, gesture = fold_along("shirt", 4)
    plan = ArmPlanner(FRONT).plan(vertices, gesture)
    left_first = starts_of(vertices, gesture)[0, 0] < starts_of(vertices, gesture)[1, 0]
    assert plan.arms == (("left", "right") if left_first else ("right", "left"))
    start = np.array([[0.12, 0.05, 0.006]])
    assert ArmPlanner(FRONT).plan(start, pick_and_drop(start, ONE, (0.1, 0))).arms == ("right",)


def test_what_a_plan_carries_is_the_fingers_way_at_the_robot_s_pace() -> None:
    vertices, gesture = fold_along("shirt", 4)
    plan = ArmPlanner(FRONT).plan(vertices, gesture)
    paths = plan.carried(gesture).paths
    assert paths is not None
    assert paths.times_secs[-1] == pytest.approx(plan.opens_secs - plan.closes_secs)
    assert paths.turns_rad[0] == pytest.approx(0.0)
    assert paths.turns_rad[-1] == pytest.approx(np.pi)
    times = np.array([0.0, 0.4 * paths.times_secs[-1], paths.times_secs[-1]])
    fingers = plan.fingers_in_world(plan.closes_secs + times)
    np.testing.assert_allclose(paths.hands_at(times)[..., :3], fingers, atol=1e-4)
    starts = starts_of(vertices, gesture)
    rows = hand_paths_in_world(starts, plan.carried(gesture), 0.01)
    assert len(rows) == np.ceil(paths.times_secs[-1] / 0.01)
    np.testing.assert_allclose(rows[-1, :, :3] - starts, fingers[-1] - fingers[0], atol=1e-9)


def test_what_cannot_be_reached_says_why_and_where() -> None:
    planner = ArmPlanner(FRONT)
    start = np.array([[0.0, 0.0, 0.006]])
    assert planner.obstacle(start, pick_and_drop(start, ONE, (0.0, 0.5))) is Obstacle.OUT_OF_REACH
    assert planner.obstacle(start, pick_and_drop(start, ONE, (0.0, 0.1))) is None
    low = ArmPlanner(Stance(0.0, -0.32, -0.15, np.pi / 2))
    assert low.obstacle(start, pick_and_drop(start, ONE, (0.0, 0.1))) is Obstacle.TABLE
    with pytest.raises(UnreachableError, match=r"the left hand at \(-?0\.000, 0\.4.*out_of_reach"):
        planner.plan(start, pick_and_drop(start, ONE, (0.0, 0.5)))
    near = np.array([[-0.1, -0.26, 0.01], [0.1, -0.26, 0.01]])
    away = tuple(Hand(ONE + k, place[None] + [0.0, 0.2, 0.05]) for k, place in enumerate(near))
    assert planner.obstacle(near, Gesture(away)) is Obstacle.JOINT_LIMIT
    column = np.array([[-0.12, 0.06, 0.01], [-0.12, 0.13, 0.01]])
    together = tuple(Hand(ONE + k, place[None] + [0.2, 0.0, 0.0]) for k, place in enumerate(column))
    assert planner.obstacle(column, Gesture(together)) is Obstacle.SELF_COLLISION


def test_gestures_for_other_hands_than_two_apart_are_refused() -> None:
    starts = np.array([[-0.1, 0.0, 0.01], [-0.08, 0.0, 0.01], [0.1, 0.0, 0.01]])
    hands = tuple(Hand(ONE + k, start[None] + 0.05) for k, start in enumerate(starts))
    with pytest.raises(UnreachableError, match="3 hands for two arms") as refusal:
        ArmPlanner(FRONT).plan(starts, Gesture(hands))
    assert refusal.value.obstacle is Obstacle.TOO_MANY_HANDS
    with pytest.raises(UnreachableError, match=r"hands 0\.020 m apart"):
        ArmPlanner(FRONT).plan(starts, Gesture(hands[:2]))


def test_an_unknown_stance_is_refused() -> None:
    with pytest.raises(ValueError, match="robot_stance: expected one of front, left; got 'roof'"):
        check_stance("roof")
