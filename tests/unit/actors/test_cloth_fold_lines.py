import numpy as np
import pytest

from actors.cloth.camera import Camera
from actors.cloth.fold_lines import fold, garment_frame, plan_fold
from actors.cloth.garments import GarmentKind, make_garment
from actors.cloth.guard import guard
from actors.cloth.masks import cloth_mask
from actors.cloth.rasteriser import draw_cloth
from actors.cloth.xpbd_engine import XpbdEngine
from actors.cloth.xpbd_settings import XpbdSettings

CAMERA = Camera(view_half_width_m=0.35)
SETTINGS = XpbdSettings(table_friction=1.0, bending_compliance=1e-4)


def _turned(vertices: np.ndarray, turn_rad: float) -> np.ndarray:
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    turned = vertices.copy()
    turned[:, :2] = vertices[:, :2] @ np.array([[cosine, sine], [-sine, cosine]])
    return turned


def _mask(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return cloth_mask(draw_cloth(vertices, faces, CAMERA))


@pytest.mark.parametrize("kind", ["tshirt", "shirt", "trousers"])
@pytest.mark.parametrize("turn_deg", [-30.0, -7.0, 0.0, 18.0, 35.0])
def test_the_garments_axes_are_found_in_its_picture(kind: GarmentKind, turn_deg: float) -> None:
    mesh = make_garment(kind).mesh
    vertices = _turned(mesh.vertices_m, np.deg2rad(turn_deg)) + np.array([0.03, -0.02, 0.0])
    frame = garment_frame(_mask(vertices, mesh.faces), CAMERA)
    assert np.rad2deg(frame.turn_rad) == pytest.approx(turn_deg, abs=2.0)
    points = np.array([[0.1, 0.2], [-0.3, 0.05]])
    np.testing.assert_allclose(frame.on_table_m(frame.coordinates_m(points)), points)


def test_lines_cut_the_shape_at_quarters_and_fold_towards_its_middle() -> None:
    mesh = make_garment("trousers").mesh
    mask = _mask(mesh.vertices_m, mesh.faces)
    towards = []
    for line in range(6):
        plan = plan_fold(mask, CAMERA, line)
        axis = line // 3
        extent_m = np.ptp(mesh.vertices_m[:, axis])
        portions = [0.25, 0.5, 0.75][line % 3]
        for end in plan.line_m:
            assert end[axis] == pytest.approx((portions - 0.5) * extent_m, abs=0.02)
        for grasp, drop in zip(plan.grasps_m, plan.drops_m, strict=True):
            towards.append(np.sign(drop[axis] - grasp[axis]))
    assert towards == [1] * 4 + [-1] * 2 + [1] * 4 + [-1] * 2


def test_two_hands_take_the_ends_of_an_edge_and_one_hand_a_small_corner() -> None:
    mesh = make_garment("shirt").mesh
    plan = plan_fold(_mask(mesh.vertices_m, mesh.faces), CAMERA, 4)
    assert len(plan.grasps_m) == 2
    assert sorted(np.sign([grasp[0] for grasp in plan.grasps_m]).tolist()) == [-1, 1]
    for x_m, y_m in plan.grasps_m:
        assert abs(x_m) == pytest.approx(0.1, abs=0.03)
        assert y_m == pytest.approx(-0.19, abs=0.03)
    tiny = np.zeros((84, 84), bool)
    tiny[40:44, 40:44] = True
    assert len(plan_fold(tiny, CAMERA, 0).grasps_m) == 1


def test_what_cannot_be_folded_is_refused() -> None:
    with pytest.raises(ValueError, match="line: expected 0 to 5; got 6"):
        plan_fold(np.ones((84, 84), bool), CAMERA, 6)
    with pytest.raises(ValueError, match="mask: expected at least one pixel of cloth"):
        plan_fold(np.zeros((84, 84), bool), CAMERA, 0)


@pytest.mark.parametrize(
    ("kind", "lines", "portion"), [("shirt", (0, 2, 4), 0.45), ("trousers", (1, 4), 0.4)]
)
def test_a_garment_folds_up_along_its_lines(
    kind: GarmentKind, lines: tuple[int, ...], portion: float
) -> None:
    garment = make_garment(kind)
    engine = XpbdEngine(SETTINGS)
    engine.reset(garment.mesh)
    flat_px = _mask(engine.vertices_in_world(), garment.mesh.faces).sum()
    covered = [flat_px]
    for line in lines:
        vertices = engine.vertices_in_world()
        engine.perform(fold(vertices, plan_fold(_mask(vertices, garment.mesh.faces), CAMERA, line)))
        folded = engine.vertices_in_world()
        assert guard(garment.mesh, folded) is None
        covered.append(_mask(folded, garment.mesh.faces).sum())
    assert (np.diff(covered) < 0).all(), covered
    assert covered[-1] < portion * flat_px, covered
