import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from actors.cloth import pybullet_engine
from actors.cloth.engine import ClothEngine, ClothEngineError
from actors.cloth.engines import make_engine
from actors.cloth.gestures import Gesture, Hand, pick_and_drop
from actors.cloth.grasps import grasped_vertices
from actors.cloth.guard import guard
from actors.cloth.meshes import rectangular_sheet
from actors.cloth.pybullet_engine import PyBulletEngine
from actors.cloth.pybullet_process import PyBulletProcessEngine
from actors.cloth.pybullet_settings import PyBulletSettings
from actors.cloth.quiet_pybullet import pybullet

SHEET = rectangular_sheet(12, 0.3)
LIFT = Gesture((Hand(np.array([0]), np.array([[0.0, 0.0, 0.1]])),))
REPOSITORY = Path(pybullet_engine.__file__).resolve().parents[2]


@pytest.fixture
def engine() -> Iterator[PyBulletEngine]:
    engine = PyBulletEngine()
    yield engine
    engine.close()


@pytest.fixture
def apart() -> Iterator[PyBulletProcessEngine]:
    engine = PyBulletProcessEngine()
    yield engine
    engine.close()


def _fold(engine: ClothEngine) -> np.ndarray:
    """The left edge carried to the right."""
    vertices = engine.vertices_in_world()
    engine.perform(pick_and_drop(vertices, grasped_vertices(vertices, (-0.14, 0.0)), (0.12, 0.0)))
    return engine.vertices_in_world()


def test_a_reset_cloth_lies_where_it_was_put(engine: PyBulletEngine) -> None:
    engine.reset(SHEET)
    offset_m = engine.vertices_in_world() - SHEET.vertices_m
    assert np.abs(offset_m[:, :2]).max() < 1e-5
    assert offset_m[:, 2].min() > 0.0
    assert offset_m[:, 2].max() < 0.005
    shifted = SHEET.vertices_m * [-1.0, 1.0, 1.0] + [0.05, -0.02, 0.0]
    engine.reset(SHEET, shifted)
    assert np.abs(engine.vertices_in_world() - shifted)[:, :2].max() < 1e-5


def test_a_grasped_edge_is_carried_over_and_let_go(engine: PyBulletEngine) -> None:
    engine.reset(SHEET)
    vertices = _fold(engine)
    left_middle = grasped_vertices(SHEET.vertices_m, (-0.14, 0.0))[0]
    # Let go at 0.12 it slides on a little.
    assert 0.08 < vertices[left_middle, 0] < 0.25
    assert abs(vertices[left_middle, 1]) < 0.05
    assert guard(SHEET, vertices) is None
    assert vertices[:, 2].max() < 0.08
    assert np.abs(vertices - SHEET.vertices_m).max() > 0.1


def test_two_hands_carry_an_edge(engine: PyBulletEngine) -> None:
    engine.reset(SHEET)
    hands = []
    for corner in (0, 132):  # the left edge's ends
        y_m = SHEET.vertices_m[corner, 1]
        hands.append(Hand(np.array([corner]), np.array([(0.0, y_m, 0.12), (0.12, y_m, 0.03)])))
    engine.perform(Gesture(tuple(hands)))
    vertices = engine.vertices_in_world()
    assert guard(SHEET, vertices) is None
    assert vertices[[0, 132], 0].min() > 0.07
    assert np.ptp(vertices[:, 1]) > 0.27


def test_the_gripper_lets_go_even_when_the_carrying_fails(
    engine: PyBulletEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine.reset(SHEET)
    bodies = pybullet.getNumBodies(physicsClientId=engine._client)
    constraints = pybullet.getNumConstraints(physicsClientId=engine._client)

    def fail(*args: object, **kwargs: object) -> None:
        raise InterruptedError

    with monkeypatch.context() as patch:
        patch.setattr(pybullet, "stepSimulation", fail)
        with pytest.raises(InterruptedError):
            _fold(engine)
    assert pybullet.getNumBodies(physicsClientId=engine._client) == bodies
    assert pybullet.getNumConstraints(physicsClientId=engine._client) == constraints


def test_two_engines_do_not_see_each_other(engine: PyBulletEngine) -> None:
    other = PyBulletEngine()
    engine.reset(SHEET)
    other.reset(rectangular_sheet(4, 0.2))
    before = other.vertices_in_world()
    _fold(engine)
    np.testing.assert_array_equal(other.vertices_in_world(), before)
    other.close()
    assert len(engine.vertices_in_world()) == 144


@pytest.mark.parametrize("make", [PyBulletEngine, PyBulletProcessEngine])
def test_an_engine_without_cloth_says_so(
    make: type[PyBulletEngine] | type[PyBulletProcessEngine],
) -> None:
    engine = make()
    with pytest.raises(ClothEngineError, match=r"expected reset\(\) first"):
        engine.vertices_in_world()
    with pytest.raises(ClothEngineError, match=r"expected reset\(\) first"):
        engine.perform(LIFT)
    engine.close()
    engine.close()


def test_vertices_that_do_not_fit_are_refused(engine: PyBulletEngine) -> None:
    with pytest.raises(ValueError, match=r"expected finite f64 \[144, 3\]; got \[9, 3\]"):
        engine.reset(SHEET, np.zeros((9, 3)))


def test_an_engine_apart_repeats_itself_bit_by_bit(apart: PyBulletProcessEngine) -> None:
    other = PyBulletProcessEngine()
    other.reset(SHEET)
    _fold(other)
    other.reset(SHEET)
    apart.reset(SHEET)
    assert other.process_id != apart.process_id
    first, second = _fold(apart), _fold(other)
    other.close()
    np.testing.assert_array_equal(first, second)


def test_an_engine_apart_is_the_same_engine(
    apart: PyBulletProcessEngine, engine: PyBulletEngine
) -> None:
    apart.reset(SHEET)
    engine.reset(SHEET)
    assert np.abs(apart.vertices_in_world() - engine.vertices_in_world()).max() < 1e-6
    assert np.abs(_fold(apart) - _fold(engine)).max() < 0.02


def test_a_killed_simulator_is_reported_and_replaced(apart: PyBulletProcessEngine) -> None:
    apart.reset(SHEET)
    assert apart.process_id is not None
    os.kill(apart.process_id, signal.SIGKILL)
    with pytest.raises(ClothEngineError, match=r"expected the simulator's answer; got the end"):
        _fold(apart)
    apart.reset(SHEET)
    assert len(apart.vertices_in_world()) == 144


def test_a_hanging_simulator_is_reported(apart: PyBulletProcessEngine) -> None:
    apart.reset(SHEET)
    apart.reply_timeout_secs = 0.2
    assert apart.process_id is not None
    os.kill(apart.process_id, signal.SIGSTOP)
    with pytest.raises(ClothEngineError, match=r"got no answer within 0\.2 s"):
        _fold(apart)
    assert apart.process_id is None


def test_an_error_in_the_simulator_reaches_its_owner(apart: PyBulletProcessEngine) -> None:
    object.__setattr__(apart.settings, "friction", "rough")
    with pytest.raises(ClothEngineError, match="TypeError"):
        apart.reset(SHEET)


def test_closing_ends_the_process(apart: PyBulletProcessEngine) -> None:
    apart.reset(SHEET)
    process_id = apart.process_id
    assert process_id is not None
    apart.close()
    with pytest.raises(ProcessLookupError):
        os.kill(process_id, 0)


def test_importing_pybullet_prints_nothing() -> None:
    result = subprocess.run(
        [sys.executable, "-c", "import actors.cloth.pybullet_engine; print('after')"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    assert (result.stdout, result.stderr) == ("after\n", "")


def test_settings_are_checked() -> None:
    with pytest.raises(ValueError, match=r"time_step_secs: expected a positive number; got 0"):
        PyBulletSettings(time_step_secs=0.0)
    with pytest.raises(ValueError, match=r"engine: expected one of .*pybullet.*; got 'mujoco'"):
        make_engine("mujoco")
    with pytest.raises(ValueError, match=r"expected some of time_step_secs.*; got stiffness"):
        make_engine("pybullet", {"stiffness": 1.0})
    engine = make_engine("pybullet", {"bending_stiffness": 0.5})
    assert isinstance(engine, PyBulletProcessEngine)
    assert engine.settings.bending_stiffness == 0.5
