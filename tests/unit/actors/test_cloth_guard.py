import numpy as np
import pytest

from actors.cloth.guard import GuardReason, guard
from actors.cloth.meshes import rectangular_sheet

SHEET = rectangular_sheet(12, 0.3)


def test_a_flat_cloth_is_in_order() -> None:
    assert guard(SHEET, SHEET.vertices_m + np.array([0.1, -0.1, 0.003])) is None


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite(value: float) -> None:
    vertices = SHEET.vertices_m.copy()
    vertices[7, 2] = value
    assert guard(SHEET, vertices) is GuardReason.NOT_FINITE


def test_one_edge_is_enough_to_be_overstretched() -> None:
    vertices = SHEET.vertices_m.copy()
    cell_m = 0.3 / 11
    vertices[143, 0] += 0.9 * cell_m
    assert guard(SHEET, vertices) is None
    vertices[143, 0] += 0.2 * cell_m
    assert guard(SHEET, vertices) is GuardReason.OVERSTRETCHED


@pytest.mark.parametrize(
    "shift_m", [[0.5, 0.0, 0.0], [0.0, -0.5, 0.0], [0.0, 0.0, -0.05], [0.0, 0.0, 0.7]]
)
def test_off_the_table(shift_m: list[float]) -> None:
    assert guard(SHEET, SHEET.vertices_m + np.array(shift_m)) is GuardReason.OFF_TABLE
