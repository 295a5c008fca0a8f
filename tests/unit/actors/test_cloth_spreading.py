from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from actors.cloth.camera import Camera
from actors.cloth.engines import make_engine
from actors.cloth.garments import make_garment
from actors.cloth.gestures import pick_and_drop
from actors.cloth.grasps import grasped_vertices
from actors.cloth.masks import cloth_mask, red_mask
from actors.cloth.measures import true_coverage
from actors.cloth.pick_points import NoClothInViewError
from actors.cloth.pulls import PullKind
from actors.cloth.rasteriser import draw_cloth
from actors.cloth.spreading import (
    Point,
    Spread,
    SpreadAim,
    SpreadEnd,
    SpreadingRule,
    TableLostError,
    spread,
)

CAMERA = Camera()
GARMENT = make_garment("handkerchief")
FLAT = GARMENT.mesh.vertices_m
HALF = FLAT * [0.5, 1.0, 1.0]
"""A picture of half the area, in which nothing tells how it is folded."""

EMPTY = np.full((84, 84, 3), 200, dtype=np.uint8)


def picture(vertices: np.ndarray) -> np.ndarray:
    return draw_cloth(vertices, GARMENT.mesh.faces, CAMERA)


def shifted(vertices: np.ndarray, x_m: float, y_m: float) -> np.ndarray:
    return vertices + np.array([x_m, y_m, 0.0])


FLAT_PX = int(cloth_mask(picture(FLAT)).sum())


def rule(seed: int = 0, **aim: object) -> SpreadingRule:
    return SpreadingRule(CAMERA, FLAT_PX, np.random.default_rng(seed), SpreadAim(**aim))  # type: ignore[arg-type]


@dataclass
class PaperTable:
    """Shows prepared pictures one after the other, the last one for ever."""

    pictures: list[np.ndarray]
    error: Exception | None = None
    moves: list[tuple[Point, Point]] = field(default_factory=list)

    def look(self) -> np.ndarray:
        return self.pictures[min(len(self.moves), len(self.pictures) - 1)]

    def pick_and_drop(self, pick_xy_m: Point, drop_xy_m: Point) -> bool:
        self.moves.append((pick_xy_m, drop_xy_m))
        if self.error is not None:
            raise self.error
        return False


@dataclass
class SimulatedTable:
    """The fast engine as hand and eye."""

    def __post_init__(self) -> None:
        self.engine = make_engine("xpbd")
        self.engine.reset(GARMENT.mesh)

    def look(self) -> np.ndarray:
        return picture(self.engine.vertices_in_world())

    def pick_and_drop(self, pick_xy_m: Point, drop_xy_m: Point) -> bool:
        vertices = self.engine.vertices_in_world()
        grasped = grasped_vertices(vertices, pick_xy_m)
        self.engine.perform(pick_and_drop(vertices, grasped, drop_xy_m))
        return True

    def coverage(self) -> float:
        return true_coverage(self.engine.vertices_in_world(), GARMENT)


@pytest.fixture
def folded() -> Iterator[SimulatedTable]:
    """Cloth folded over the middle twice."""
    table = SimulatedTable()
    table.pick_and_drop((0.14, 0.14), (-0.05, -0.05))
    table.pick_and_drop((-0.14, 0.14), (0.0, -0.02))
    yield table
    table.engine.close()


def spread_on(table: PaperTable | SimulatedTable, seed: int = 0, actions: int = 25) -> Spread:
    random = np.random.default_rng(seed)
    return spread(table, CAMERA, FLAT_PX, random, SpreadAim(actions=actions))


def test_folded_cloth_comes_to_lie_flat_in_the_middle(folded: SimulatedTable) -> None:
    assert folded.coverage() < 0.7
    outcome = spread_on(folded)
    assert outcome.end is SpreadEnd.SPREAD
    assert folded.coverage() > 0.9
    assert outcome.coverage == pytest.approx(folded.coverage(), abs=0.05)
    assert np.linalg.norm(folded.engine.vertices_in_world()[:, :2].mean(axis=0)) < 0.06


def test_the_same_seed_makes_the_same_pulls() -> None:
    tables = [PaperTable([picture(HALF)]) for _ in range(3)]
    for table, seed in zip(tables, (4, 4, 5), strict=True):
        assert spread_on(table, seed, actions=6) == Spread(
            cloth_mask(picture(HALF)).sum() / FLAT_PX, 6, SpreadEnd.OUT_OF_ACTIONS
        )
    assert tables[0].moves == tables[1].moves != tables[2].moves


def test_what_brings_nothing_is_not_done_again_and_again() -> None:
    table = PaperTable([picture(HALF)])
    spread_on(table, actions=6)
    picks = np.array([pick for pick, _ in table.moves])
    assert np.ptp(picks, axis=0).max() > 0.1


def test_drop_points_stay_in_the_picture() -> None:
    aside = shifted(HALF, 0.15, 0.1)
    table = PaperTable([picture(aside), picture(shifted(HALF, 0.0, 0.1))])
    spread_on(table, actions=8)
    assert np.abs([drop for _, drop in table.moves]).max() < CAMERA.view_half_width_m


def test_spread_cloth_is_left_alone_whichever_side_is_up() -> None:
    for vertices in (FLAT, FLAT * [-1.0, 1.0, 1.0]):
        table = PaperTable([picture(vertices)])
        assert spread_on(table, actions=0).end is SpreadEnd.SPREAD
        assert table.moves == []


def test_the_wrong_side_is_turned_where_one_is_asked_for() -> None:
    assert rule(up="green").next_pull(picture(FLAT)) is None
    turned = picture(FLAT * [-1.0, 1.0, 1.0])
    pull = rule(up="green").next_pull(turned)
    assert pull is not None
    assert pull.kind is PullKind.TURN
    assert rule(up="red").next_pull(turned) is None


@pytest.mark.parametrize("seed", range(3))
def test_cloth_is_turned_over_and_spread_in_ten_actions(seed: int) -> None:
    table = SimulatedTable()
    random = np.random.default_rng(seed)
    outcome = spread(table, CAMERA, FLAT_PX, random, SpreadAim(up="red", actions=10))
    assert outcome.end is SpreadEnd.SPREAD
    assert table.coverage() > 0.9
    seen = table.look()
    assert red_mask(seen).sum() == cloth_mask(seen).sum()
    table.engine.close()


@pytest.mark.parametrize("shift_m", [0.07, 0.14])
def test_cloth_off_the_middle_or_cut_off_is_centred_first(shift_m: float) -> None:
    pull = rule().next_pull(picture(shifted(FLAT, shift_m, 0.0)))
    assert pull is not None
    assert pull.kind is PullKind.CENTRE


def test_it_says_why_it_ended() -> None:
    half = picture(HALF)
    assert spread_on(PaperTable([EMPTY])) == Spread(0.0, 0, SpreadEnd.NO_CLOTH_IN_VIEW)
    assert spread_on(PaperTable([half, EMPTY])) == Spread(0.0, 1, SpreadEnd.NO_CLOTH_IN_VIEW)
    lost = spread_on(PaperTable([half], NoClothInViewError("gone")))
    assert lost == Spread(0.0, 1, SpreadEnd.NO_CLOTH_IN_VIEW)
    stopped = spread_on(PaperTable([half], TableLostError("protective stop")))
    assert (stopped.actions, stopped.end) == (1, SpreadEnd.TABLE_LOST)
    assert stopped.coverage == pytest.approx(0.5, abs=0.02)
    done = spread_on(PaperTable([half, picture(FLAT)]))
    assert (done.actions, done.end) == (1, SpreadEnd.SPREAD)


def test_another_camera_s_picture_is_refused() -> None:
    larger = draw_cloth(FLAT, GARMENT.mesh.faces, replace(CAMERA, size_px=100))
    with pytest.raises(ValueError, match=r"expected uint8 \[84, 84, 3\], .* got \[100, 100, 3\]"):
        rule().next_pull(larger)
    with pytest.raises(ValueError, match=r"picture: expected uint8 \[H, W, 3\]; got float64"):
        rule().next_pull(larger / 255)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="flat_px: expected the pixels"):
        spread(PaperTable([EMPTY]), CAMERA, 0, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("aim", "message"),
    [
        ({"coverage": 1.2}, r"SpreadAim\.coverage: expected a portion .* got 1\.2"),
        ({"off_middle_m": 0.0}, r"SpreadAim: expected a positive off_middle_m .* got 0\.0 and 25"),
        ({"actions": -1}, r"SpreadAim: .* actions of at least 0; got 0\.05 and -1"),
        ({"up": "blue"}, r"SpreadAim\.up: expected None, 'green' or 'red'; got 'blue'"),
    ],
)
def test_an_aim_out_of_its_rule_is_refused(aim: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rule(**aim)
