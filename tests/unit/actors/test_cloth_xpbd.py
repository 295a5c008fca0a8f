import hashlib
import subprocess
import sys

import numpy as np
import pytest

from actors.cloth import xpbd_engine
from actors.cloth.engine import ClothEngine, ClothEngineError
from actors.cloth.engines import make_engine
from actors.cloth.gestures import Gesture, Hand, pick_and_drop
from actors.cloth.grasps import grasped_vertices
from actors.cloth.guard import GuardReason, guard
from actors.cloth.meshes import edge_lengths_m, rectangular_sheet
from actors.cloth.xpbd_constraints import distance_constraints
from actors.cloth.xpbd_engine import NEIGHBOUR_SPACINGS, XpbdEngine
from actors.cloth.xpbd_settings import XpbdSettings

SHEET = rectangular_sheet(20, 0.3)
LIFT = Gesture((Hand(np.array([0]), np.array([[0.0, 0.0, 0.1]])),))


@pytest.fixture
def engine() -> XpbdEngine:
    engine = XpbdEngine()
    engine.reset(SHEET)
    return engine


def _fold(engine: ClothEngine) -> np.ndarray:
    """The left edge carried to the right."""
    vertices = engine.vertices_in_world()
    engine.perform(pick_and_drop(vertices, grasped_vertices(vertices, (-0.15, 0.0)), (0.12, 0.0)))
    return engine.vertices_in_world()


def _crumple(engine: ClothEngine, actions: int) -> np.ndarray:
    generator = np.random.default_rng(3)
    for _ in range(actions):
        vertices = engine.vertices_in_world()
        pick_xy_m = vertices[generator.integers(len(vertices)), :2]
        x_m, y_m = generator.uniform(-0.1, 0.1, 2)
        grasped = grasped_vertices(vertices, (pick_xy_m[0], pick_xy_m[1]))
        engine.perform(pick_and_drop(vertices, grasped, (x_m, y_m)))
    return engine.vertices_in_world()


def test_a_reset_cloth_lies_where_it_was_put(engine: XpbdEngine) -> None:
    np.testing.assert_allclose(engine.vertices_in_world()[:, :2], SHEET.vertices_m[:, :2])
    assert np.ptp(engine.vertices_in_world()[:, 2]) < 1e-4
    shifted = SHEET.vertices_m * [-1.0, 1.0, 1.0] + [0.05, -0.02, 0.0]
    engine.reset(SHEET, shifted)
    np.testing.assert_allclose(engine.vertices_in_world()[:, :2], shifted[:, :2], atol=1e-6)


def test_an_edge_carried_over_stays_there_in_a_second_layer(engine: XpbdEngine) -> None:
    vertices = _fold(engine)
    left_middle = grasped_vertices(SHEET.vertices_m, (-0.15, 0.0))[0]
    # Let go at 0.12 and 3 cm high, it slides on a little.
    assert 0.08 < vertices[left_middle, 0] < 0.25
    assert abs(vertices[left_middle, 1]) < 0.03
    assert guard(SHEET, vertices) is None
    thickness_m = 0.8 * 0.3 / 19
    assert (vertices[:, 2] > 1.2 * thickness_m).sum() > 40, "the cloth lies on itself"
    assert vertices[:, 2].max() < 0.1


def test_two_hands_fold_one_half_over_the_other(engine: XpbdEngine) -> None:
    vertices = engine.vertices_in_world()
    corners = [np.array([0]), np.array([380])]  # the left edge's ends
    stations = [
        np.array(
            [
                (0.15 * (k / 8 * 2 - 1), vertices[corner[0], 1], 0.1 * np.sin(np.pi * k / 8) + 0.02)
                for k in range(1, 9)
            ]
        )
        for corner in corners
    ]
    engine.perform(Gesture(tuple(Hand(*pair) for pair in zip(corners, stations, strict=True))))
    folded = engine.vertices_in_world()
    assert guard(SHEET, folded) is None
    left_edge = folded[SHEET.vertices_m[:, 0] < -0.149]
    assert left_edge[:, 0].min() > 0.08
    assert np.ptp(folded[:, 0]) < 0.2
    assert np.ptp(folded[:, 1]) > 0.28


def test_cloth_slips_out_of_hands_that_would_tear_it(engine: XpbdEngine) -> None:
    engine.reset(SHEET)
    sides = [np.flatnonzero(np.isclose(SHEET.vertices_m[:, 0], x_m)) for x_m in (-0.15, 0.15)]
    apart = [np.array([[x_m, 0.0, 0.05]]) for x_m in (-0.4, 0.4)]
    hands = tuple(Hand(ids, stations) for ids, stations in zip(sides, apart, strict=True))
    engine.perform(Gesture(hands))
    pulled = engine.vertices_in_world()
    assert guard(SHEET, pulled) is None
    assert np.ptp(pulled[:, 0]) < 0.35


def test_crumpled_cloth_keeps_its_lengths_and_its_layers_apart(engine: XpbdEngine) -> None:
    vertices = _crumple(engine, 8)
    stretch = edge_lengths_m(vertices, SHEET.edges) / SHEET.rest_edge_lengths_m
    assert np.quantile(stretch, 0.95) < 1.1
    assert stretch.max() < 1.5
    thickness_m = 0.8 * SHEET.spacing_m
    distances_m = np.linalg.norm(vertices[:, None] - vertices, axis=-1)
    at_rest_m = np.linalg.norm(SHEET.vertices_m[:, None] - SHEET.vertices_m, axis=-1)
    distances_m[at_rest_m < NEIGHBOUR_SPACINGS * SHEET.spacing_m] = np.inf
    assert np.quantile(distances_m.min(axis=1), 0.05) > 0.8 * thickness_m
    assert vertices[:, 2].min() > 0.4 * thickness_m


def test_cloth_at_rest_stays_at_rest(engine: XpbdEngine) -> None:
    _fold(engine)
    state = engine.save()
    engine._settle(least_secs=0.0)
    moved_m = np.linalg.norm(engine.vertices_in_world() - state.positions_m, axis=1)
    assert moved_m.max() < 0.02


def test_a_saved_state_is_returned_to_exactly(engine: XpbdEngine) -> None:
    _crumple(engine, 2)
    state = engine.save()
    once = _fold(engine)
    engine.restore(state)
    np.testing.assert_array_equal(_fold(engine), once)
    other = XpbdEngine()
    other.restore(state)
    np.testing.assert_array_equal(_fold(other), once)


_IN_ANOTHER_PROCESS = """
import hashlib
from tests.unit.actors.test_cloth_xpbd import SHEET, XpbdEngine, _crumple
engine = XpbdEngine()
engine.reset(SHEET)
print(hashlib.sha256(_crumple(engine, 3).tobytes()).hexdigest())
"""


def test_another_process_computes_the_same_bits(engine: XpbdEngine) -> None:
    result = subprocess.run(
        [sys.executable, "-c", _IN_ANOTHER_PROCESS], capture_output=True, text=True, check=True
    )
    here = hashlib.sha256(_crumple(engine, 3).tobytes()).hexdigest()
    assert result.stdout.strip() == here


def test_a_cloth_of_another_mesh_takes_its_place(engine: XpbdEngine) -> None:
    small = rectangular_sheet(6, 0.1)
    engine.reset(small)
    assert engine.mesh is small
    assert engine.vertices_in_world().shape == (36, 3)


def test_the_guard_sees_what_the_solver_gives_up(
    engine: XpbdEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine._body.positions_m[1, 7] = np.nan
    assert guard(SHEET, _fold(engine)) is GuardReason.NOT_FINITE
    monkeypatch.setattr(xpbd_engine, "ROOM_FOR_PAIRS", 0)
    crowded = XpbdEngine()
    crowded.reset(SHEET)
    assert guard(SHEET, _fold(crowded)) is GuardReason.NOT_FINITE


def test_an_engine_without_cloth_says_so() -> None:
    engine = XpbdEngine()
    for use in (
        engine.vertices_in_world,
        engine.save,
        lambda: engine.perform(LIFT),
    ):
        with pytest.raises(ClothEngineError, match=r"expected reset\(\) first"):
            use()
    engine.close()
    engine.close()


def test_wrong_arguments_are_named(engine: XpbdEngine) -> None:
    with pytest.raises(ValueError, match=r"expected finite f64 \[400, 3\]; got \[9, 3\]"):
        engine.reset(SHEET, np.zeros((9, 3)))
    with pytest.raises(ValueError, match="expected ids from 0 to 399"):
        engine.perform(Gesture((Hand(np.array([400]), np.zeros((1, 3))),)))
    with pytest.raises(ValueError, match="expected a finite number, more than 0; got 0"):
        make_engine("xpbd", {"substeps_per_sec": 0})
    with pytest.raises(ValueError, match="engine settings of xpbd: expected some of"):
        make_engine("xpbd", {"elastic_stiffness": 1.0})


def test_constraints_of_a_sheet_are_its_threads_diagonals_and_bends() -> None:
    settings = XpbdSettings(stretch_compliance=1e-9)
    sheet = rectangular_sheet(4, 0.3)
    constraints = distance_constraints(sheet, settings)
    kinds = [settings.stretch_compliance, settings.shear_compliance, settings.bending_compliance]
    assert [int((constraints.compliances == kind).sum()) for kind in kinds] == [24, 18, 20]
    assert sheet.spacing_m == pytest.approx(0.1)
    assert len({tuple(pair) for pair in constraints.pairs.tolist()}) == 62
