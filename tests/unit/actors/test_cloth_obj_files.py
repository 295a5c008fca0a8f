from pathlib import Path

import numpy as np
import pytest

from actors.cloth.garments import make_garment
from actors.cloth.meshes import rectangular_sheet
from actors.cloth.obj_files import ObjFileError, read_obj, write_obj


@pytest.fixture
def obj(tmp_path: Path) -> Path:
    return tmp_path / "cloth.obj"


def _write(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    lines = ["# by hand", "o cloth", *(f"v {x} {y} {z}" for x, y, z in vertices)]
    lines += ["f " + " ".join(f"{i + 1}/1/1" for i in face) for face in faces]
    path.write_text("\n".join(lines))


@pytest.mark.parametrize("kind", ["handkerchief", "tshirt", "trousers"])
def test_what_is_written_is_read_again(obj: Path, kind: str) -> None:
    mesh = make_garment(kind).mesh  # type: ignore[arg-type]
    write_obj(mesh, obj)
    read = read_obj(obj)
    assert len(read.vertices_m) == len(mesh.vertices_m)
    assert len(read.faces) == len(mesh.faces)
    assert len(read.edges) == len(mesh.edges)
    middle = (mesh.vertices_m.min(axis=0) + mesh.vertices_m.max(axis=0)) / 2
    distances = np.linalg.norm(read.vertices_m[:, None] - (mesh.vertices_m - middle), axis=2)
    assert distances.min(axis=1).max() < 1e-6


def test_quads_seams_axes_and_scale_of_other_programs_are_understood(obj: Path) -> None:
    # Two rows of quads in centimetres, lying in the x-z plane, their seam's vertices double.
    left = [(x, 0.0, z) for z in (0, 10, 20) for x in (0, 10)]
    right = [(x, 0.0, z) for z in (0, 10, 20) for x in (10, 20)]
    quads = np.array([[0, 1, 3, 2], [2, 3, 5, 4]])
    _write(obj, np.array(left + right), np.concatenate([quads, quads + 6]))
    mesh = read_obj(obj, metres_per_unit=0.01)
    assert len(mesh.vertices_m) == 9
    assert len(mesh.faces) == 8
    np.testing.assert_allclose(np.ptp(mesh.vertices_m, axis=0), [0.2, 0.2, 0.0])
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_negative_ids_count_from_the_end(obj: Path) -> None:
    obj.write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf -3 -2 -1\n")
    assert len(read_obj(obj).faces) == 1


def test_files_that_are_no_cloth_are_refused(obj: Path) -> None:
    sheet = rectangular_sheet(4, 0.3)
    vertices, faces = sheet.vertices_m, sheet.faces
    far = vertices + np.array([0.5, 0.0, 0.0])
    over = np.concatenate([vertices, vertices[[5, 6, 9]] + np.array([0.001, 0.0, 0.0])])
    bent = vertices + np.outer(vertices[:, 0] > 0, [0.0, 0.0, 0.1])
    spike = vertices.copy()
    spike[0] = [-0.7, -0.15, 0.0]
    touching = np.concatenate([vertices, vertices[1:] + np.array([0.3, 0.3, 0.0])])
    second = np.where(faces == 0, 15, faces + 15)
    cases: list[tuple[np.ndarray, np.ndarray, str]] = [
        (vertices * 100, faces, "garment of 0.05 to 1.0 m; got 30 m; give its scale"),
        (bent, faces, "a flat mesh, its height at most 2%"),
        (
            np.concatenate([vertices, far]),
            np.concatenate([faces, faces + 16]),
            "one connected piece; got 2 pieces",
        ),
        (
            np.concatenate([vertices, vertices[[5]] + np.array([0.02, 0.01, 0.0])]),
            np.concatenate([faces, [[5, 6, 16]]]),
            "one layer: an edge between at most two triangles",
        ),
        (touching, np.concatenate([faces, second]), "1 vertices where they only touch"),
        (spike, faces, "angles of at least 12 degrees"),
        (over, np.concatenate([faces, [[0, 1, 1]]]), "triangles with an area; got 1 without"),
        (vertices * np.nan, faces, "finite coordinates"),
    ]
    for points, triangles, complaint in cases:
        _write(obj, points, triangles)
        with pytest.raises(ObjFileError, match=r"cloth\.obj: expected") as refusal:
            read_obj(obj)
        assert complaint in str(refusal.value)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "a mesh with faces; got 0 vertices and no face"),
        ("v 0 0 0\nv 1 0 0\n", "got 2 vertices and no face"),
        ("v 0 0 0\nf 1 2 3\n", "'f 1 2 3' in line 2 (there is no vertex 2)"),
        ("v 0 zero 0\n", "in line 1"),
        ("v 0 0\n", "three coordinates"),
        ("v 0 0 0\nf 1 1\n", "three vertices make a face"),
        ("v 0 0 0\nf 0 1 1\n", "there is no vertex 0"),
    ],
)
def test_broken_files_are_refused_with_their_line(obj: Path, text: str, complaint: str) -> None:
    obj.write_text(text)
    with pytest.raises(ObjFileError) as refusal:
        read_obj(obj)
    assert complaint in str(refusal.value)


def test_a_scale_must_be_one(obj: Path) -> None:
    with pytest.raises(ValueError, match="metres_per_unit: expected a positive number; got 0"):
        read_obj(obj, metres_per_unit=0.0)
