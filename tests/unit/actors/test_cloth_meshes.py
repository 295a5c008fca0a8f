import numpy as np
import pytest

from actors.cloth.meshes import ClothMesh, edge_lengths_m, rectangular_sheet, refined


def _areas_m2(mesh: ClothMesh) -> np.ndarray:
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)[:, 2] / 2


def test_a_sheet_covers_its_square_with_its_front_up() -> None:
    mesh = rectangular_sheet(12, 0.3)
    areas_m2 = _areas_m2(mesh)
    assert (areas_m2 > 0).all()
    assert areas_m2.sum() == pytest.approx(0.3**2)
    assert mesh.vertices_m.shape == (144, 3)
    np.testing.assert_allclose(mesh.vertices_m.mean(axis=0), 0.0, atol=1e-12)


@pytest.mark.parametrize("n", [2, 3, 12])
def test_a_sheet_has_each_edge_once(n: int) -> None:
    mesh = rectangular_sheet(n, 0.3)
    assert len(mesh.edges) == 2 * n * (n - 1) + (n - 1) ** 2
    assert len(np.unique(mesh.edges, axis=0)) == len(mesh.edges)
    cell_m = 0.3 / (n - 1)
    rest = np.unique(mesh.rest_edge_lengths_m.round(9))
    np.testing.assert_allclose(rest, np.round([cell_m, cell_m * np.sqrt(2)], 9))


def test_the_diagonals_of_neighbouring_cells_alternate() -> None:
    mesh = rectangular_sheet(3, 0.2)
    ends = mesh.vertices_m[mesh.edges]
    across = ends[:, 1, :2] - ends[:, 0, :2]
    diagonal = np.abs(across).min(axis=1) > 1e-9
    assert sorted(np.sign(across[diagonal].prod(axis=1)).tolist()) == [-1, -1, 1, 1]


def test_edge_lengths_follow_the_vertices() -> None:
    mesh = rectangular_sheet(4, 0.3)
    np.testing.assert_allclose(
        edge_lengths_m(2 * mesh.vertices_m, mesh.edges), 2 * mesh.rest_edge_lengths_m
    )


def test_a_refined_mesh_is_the_same_cloth_of_half_the_spacing() -> None:
    mesh = rectangular_sheet(4, 0.3)
    fine = refined(mesh)
    np.testing.assert_array_equal(fine.vertices_m[: len(mesh.vertices_m)], mesh.vertices_m)
    assert len(fine.vertices_m) == 7 * 7
    assert fine.spacing_m == pytest.approx(mesh.spacing_m / 2)
    corners = fine.vertices_m[fine.faces]
    areas_m2 = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    assert areas_m2.min() > 0.0, "each triangle has its front side up"
    assert areas_m2.sum() == pytest.approx(0.3**2)


@pytest.mark.parametrize(("n", "size_m"), [(1, 0.3), (12, 0.0), (12, float("nan"))])
def test_an_impossible_sheet_is_refused(n: int, size_m: float) -> None:
    with pytest.raises(ValueError, match="expected"):
        rectangular_sheet(n, size_m)


def test_a_mesh_checks_its_arrays() -> None:
    good = rectangular_sheet(3, 0.3)
    with pytest.raises(ValueError, match=r"vertices_m: expected float64 .* got float32"):
        ClothMesh(good.vertices_m.astype(np.float32), good.faces)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected vertex ids from 0 to 8; got 1 to 9"):
        ClothMesh(good.vertices_m, good.faces + np.int32(1))
