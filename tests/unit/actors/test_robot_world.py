"""Cloth carried by the robot, on both engines: fingers and cloth go together."""

from collections.abc import Iterator

import numpy as np
import pytest

from actors.cloth.carried import CarriedPaths
from actors.cloth.engine import ClothEngine, Film
from actors.cloth.engines import make_engine
from actors.cloth.gestures import Gesture, pick_and_drop
from actors.cloth.grasps import grasped_vertices
from actors.cloth.guard import guard
from actors.cloth.meshes import rectangular_sheet
from actors.cloth.pybullet_engine import PyBulletEngine
from actors.cloth.quiet_pybullet import pybullet
from actors.robot.model import WITHDRAWN_POSE_RAD
from actors.robot.motion import MotionPlan
from actors.robot.planning import ArmPlanner
from actors.robot.stances import STANCES

FRONT = STANCES["front"]
SHEET = rectangular_sheet(6, 0.2)


@pytest.fixture(params=["xpbd", "pybullet"])
def engine(request) -> Iterator[ClothEngine]:
    engine = make_engine(request.param, stance=FRONT)
    engine.reset(SHEET)
    yield engine
    engine.close()


def planned(engine: ClothEngine, drop_xy_m=(0.02, 0.0)) -> tuple[Gesture, MotionPlan]:
    vertices = engine.vertices_in_world()
    gesture = pick_and_drop(vertices, grasped_vertices(vertices, (-0.1, 0.0)), drop_xy_m)
    plan = ArmPlanner(FRONT).plan(vertices, gesture)
    return plan.carried(gesture), plan


def test_cloth_goes_where_the_fingers_go(engine: ClothEngine) -> None:
    gesture, plan = planned(engine)
    film, grasped = Film(0.25), gesture.hands[0].grasped
    engine.perform(gesture, film)
    assert len(film.frames) == np.ceil((plan.opens_secs - plan.closes_secs) / film.every_secs)
    times = plan.closes_secs + np.arange(len(film.frames)) * film.every_secs
    fingers = plan.fingers_in_world(times)[:, 0]
    held = np.stack([frame[grasped] for frame in film.frames])
    # PyBullet's anchors give way a little where the cloth pulls.
    np.testing.assert_allclose(
        held - held[0], (fingers - fingers[0])[:, None].repeat(len(grasped), 1), atol=5e-3
    )
    assert held[..., 2].max() > 0.08
    assert guard(SHEET, engine.vertices_in_world()) is None


def test_filming_changes_nothing(engine: ClothEngine) -> None:
    gesture, _ = planned(engine, drop_xy_m=(-0.08, 0.0))
    engine.perform(gesture)
    unseen = engine.vertices_in_world()
    engine.reset(SHEET)
    engine.perform(gesture, Film(0.1))
    np.testing.assert_array_equal(engine.vertices_in_world(), unseen)


def test_the_robot_stands_in_pybullet_s_world_and_its_fingers_carry(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    engine = PyBulletEngine(stance=FRONT)
    engine.reset(SHEET)
    gesture, plan = planned(engine)
    robot, fingers = engine._robot, []
    assert robot is not None
    step = pybullet.stepSimulation

    def watched(**keywords: int) -> None:
        fingers.append(robot.fingers_in_world(plan.arms[0]))
        step(**keywords)

    monkeypatch.setattr(pybullet, "stepSimulation", watched)
    engine.perform(gesture)
    n_steps = int(np.ceil((plan.opens_secs - plan.closes_secs) * 400))
    times = np.minimum(plan.closes_secs + np.arange(1, n_steps + 1) / 400, plan.opens_secs)
    expected = plan.fingers_in_world(times)[:, 0]
    np.testing.assert_allclose(fingers[:n_steps], expected, atol=2e-5)
    angles = [
        pybullet.getJointState(robot.body_id, link, physicsClientId=engine._client)[0]
        for link in robot.links
    ]
    np.testing.assert_allclose(angles, WITHDRAWN_POSE_RAD, atol=1e-6)
    engine.close()


def test_carried_paths_cross_a_pipe_unchanged() -> None:
    random = np.random.default_rng(0)
    paths = CarriedPaths(
        np.arange(4) * 0.1, random.normal(size=(4, 2, 3)), random.normal(size=(4, 2)),
        random.normal(size=(4, 15)), ("right", "left"),
    )  # fmt: skip
    again = CarriedPaths.from_wire(paths.to_wire())
    assert again.arms == paths.arms
    for name in ("times_secs", "positions_in_world", "turns_rad", "joints_rad"):
        np.testing.assert_array_equal(getattr(again, name), getattr(paths, name))
    halfway = paths.hands_at(np.array([0.15]))[0, :, :3]
    np.testing.assert_allclose(halfway, paths.positions_in_world[1:3].mean(axis=0))
    np.testing.assert_allclose(paths.joints_at(np.array([9.0]))[0], paths.joints_rad[-1])
    np.testing.assert_allclose(paths.steps_secs(0.2), [0.2, 0.3])
