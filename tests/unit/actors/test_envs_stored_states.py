"""Initial states in files: the very same cloth, and nothing else is taken for it."""

import os
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.cloth.garments import make_garment
from actors.envs import ClothTaskEnv, make_env
from actors.envs.stored_states import (
    GRID_M,
    StoredStates,
    mesh_digest,
    on_grid,
    packaged_states,
    read_stored_states,
    write_stored_states,
)

SPACING_M = 0.3 / 11
GARMENT = make_garment("handkerchief", spacing_m=SPACING_M)
TABLE_43 = ("flat", "random", "folded_over")
TABLE_45 = ("flat", "rotated", "shifted", "creased")


def make(env_id: str, **given: Any) -> ClothTaskEnv:
    env = make_env(f"clothbus/{env_id}-v0", **given).unwrapped
    assert isinstance(env, ClothTaskEnv)
    return env


def lying() -> StoredStates:
    """The handkerchief in five places."""
    places_m = np.zeros((5, 1, 3)) + np.linspace(-0.05, 0.05, 5)[:, None, None] * [1, 0, 0]
    return StoredStates(
        "clothbus/HandkerchiefFlip36-v0",
        "handkerchief",
        mesh_digest(GARMENT.mesh),
        ("shifted", "flat", "shifted", "shifted", "shifted"),
        np.arange(5),
        on_grid(GARMENT.mesh.vertices_m + places_m + [0.0, 0.0, 0.01]),
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "new" / "states.npz"
    write_stored_states(path, lying())
    return path


@pytest.mark.parametrize(
    ("env_id", "source", "names"),
    [
        ("HandkerchiefFlip36", "handkerchief", TABLE_43),
        ("HandkerchiefFlip60", "handkerchief", TABLE_43),
        ("ShirtFold", "shirt", TABLE_45),
        ("TrousersFold", "trousers", TABLE_45),
    ],
)
def test_those_that_come_along_are_sound_unsolved_cloth_of_todays_garments(
    env_id: str, source: str, names: tuple[str, ...]
) -> None:
    assert source in packaged_states()
    states = read_stored_states(source)
    assert Counter(states.names) == dict.fromkeys(names, 10)
    assert len({lying.tobytes() for lying in states.vertices_m}) == len(states.names)
    env = make(env_id, stored_states=source)  # which guards all of them
    for start in states.starts()[3::10]:
        _, info = env.reset(seed=0, options=start.reset_options)
        assert (info["guard"], info["success"]) == (None, False), start.reset_options
        assert info.items() >= start.reset_options.items()
        np.testing.assert_array_equal(env.vertices_in_world(), start.vertices_m)


def test_an_episode_from_a_stored_state_has_the_same_bits_again() -> None:
    def episode(env: ClothTaskEnv, seed: int) -> list[bytes]:
        env.reset(seed=seed, options={"initial_state": "folded_over", "stored_index": 3})
        seen = [env.vertices_in_world().tobytes()]
        for action in (14, 3):
            env.step(action)
            seen.append(env.vertices_in_world().tobytes())
        return seen

    env = make("HandkerchiefFlip36", stored_states="handkerchief")
    once = episode(env, seed=1)
    assert episode(env, seed=2) == once
    assert episode(make("HandkerchiefFlip36", stored_states="handkerchief"), seed=3) == once


def test_without_an_index_the_seed_draws_one(file: Path) -> None:
    env = make("HandkerchiefFlip36", spacing_m=SPACING_M, stored_states=str(file))
    infos = [env.reset(seed=seed, options={"initial_state": "shifted"})[1] for seed in range(30)]
    drawn = [info["stored_index"] for info in infos]
    assert set(drawn) == {0, 1, 2, 3}
    again = env.reset(seed=7, options={"initial_state": "shifted"})[1]
    assert again["stored_index"] == drawn[7]
    _, info = env.reset(seed=0)
    assert (info["initial_state"], info["stored_index"]) == ("flat", 0)


def test_a_randomisation_changes_the_picture_and_leaves_the_cloth_as_it_is_stored(
    file: Path,
) -> None:
    conditions = {"shift_m": 0.1, "turn_rad": 1.0, "creases": 3, "colours": 20.0, "noise": 3.0}
    given = {"spacing_m": SPACING_M, "stored_states": str(file)}
    usual, _ = make("HandkerchiefFlip36", **given).reset(seed=0)
    env = make("HandkerchiefFlip36", randomisation=conditions, start_shift_m=0.1, **given)
    picture, _ = env.reset(seed=0)
    assert (picture != usual).any()
    flat = read_stored_states(str(file)).start("flat", 0)
    np.testing.assert_array_equal(env.vertices_in_world(), flat.vertices_m)
    with pytest.raises(ValueError, match=r"leaves the garment's size alone; got size 0\.1"):
        make("HandkerchiefFlip36", randomisation={"size": 0.1}, **given)


def test_pybullet_lets_the_stored_cloth_come_to_rest_near_by(file: Path) -> None:
    env = make("HandkerchiefFlip36", engine="pybullet", stored_states=str(file))
    _, info = env.reset(seed=0, options={"initial_state": "shifted", "stored_index": 3})
    vertices = env.vertices_in_world()
    env.close()
    stored = read_stored_states(str(file)).start("shifted", 3).vertices_m
    assert info["guard"] is None
    assert np.abs(vertices - stored)[:, :2].max() < 0.002


# The file -------------------------------------------------------------------------------------


def test_what_is_read_is_what_was_written_bit_by_bit(file: Path) -> None:
    written, read = lying(), read_stored_states(str(file))
    assert read.digest == written.digest
    assert (read.task, read.garment, read.names) == (written.task, written.garment, written.names)
    np.testing.assert_array_equal(read.seeds, written.seeds)
    np.testing.assert_array_equal(read.vertices_m, written.vertices_m)
    before = file.read_bytes()
    write_stored_states(file, read)
    assert file.read_bytes() == before


def test_the_grid_is_finer_than_cloth_can_tell() -> None:
    vertices = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 3))
    stored = on_grid(vertices)
    assert np.abs(stored - vertices).max() <= GRID_M / 2
    np.testing.assert_array_equal(on_grid(stored.astype(np.float64)), stored)


def test_a_file_cut_off_anywhere_is_refused(file: Path) -> None:
    whole = file.read_bytes()
    for size_bytes in range(0, len(whole), 61):
        file.write_bytes(whole[:size_bytes])
        with pytest.raises(ValueError, match=r"states.npz: expected a whole file of states; got"):
            read_stored_states(str(file))


def test_a_flipped_byte_is_refused_or_changes_nothing(file: Path) -> None:
    whole, digest = file.read_bytes(), lying().digest
    refused = 0
    for place in range(0, len(whole), 37):
        damaged = bytearray(whole)
        damaged[place] ^= 0xFF
        file.write_bytes(damaged)
        try:
            assert read_stored_states(str(file)).digest == digest
        except ValueError:
            refused += 1
    assert refused > 0.7 * len(whole) / 37


def test_a_full_disk_leaves_the_file_as_it_was(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: int) -> None:
        raise OSError("No space left on device")

    before = file.read_bytes()
    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OSError, match="No space left"):
        write_stored_states(file, replace(lying(), seeds=np.arange(5) + 7))
    assert file.read_bytes() == before


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"schema_version": np.int64(2)}, "schema_version: expected 1; got 2"),
        ({"schema_version": None}, "schema_version: expected 1; got none"),
        ({"seeds": None}, "arrays: expected seeds too"),
        ({"names": np.array(["flat"] * 4 + ["wet"])}, "names: expected some of .*; got wet"),
        ({"names": np.arange(5)}, "names: expected text"),
        ({"seeds": np.arange(4)}, r"seeds: expected int64 \[5\].*; got int64 \[4\]"),
        ({"vertices_m": np.zeros((5, 3, 9))}, "vertices_m: expected float32 .*; got float64"),
        ({"vertices_m": np.zeros(5, np.float32)}, "vertices_m: expected 3 axes"),
        ({"vertices_m": np.full((5, 3, 9), np.nan, np.float32)}, "expected finite numbers"),
        ({"task": np.array([{}], dtype=object)}, "allow_pickle"),
    ],
)
def test_a_file_of_something_else_says_what_is_wrong(
    file: Path, change: dict[str, Any], complaint: str
) -> None:
    with np.load(file) as arrays:
        given = {**arrays, **change}
    np.savez(file, **{name: array for name, array in given.items() if array is not None})
    with pytest.raises(ValueError, match=f"stored_states .*states.npz: .*{complaint}"):
        read_stored_states(str(file))


def test_states_of_another_garment_are_refused(file: Path) -> None:
    with pytest.raises(
        ValueError, match=r"expected states of .* 400 vertices; got .* 144 vertices"
    ):
        make("HandkerchiefFlip36", stored_states=str(file))
    with pytest.raises(ValueError, match="expected states of this garment, trousers"):
        make("TrousersFold", stored_states="shirt")


def test_broken_cloth_is_refused(file: Path) -> None:
    vertices = lying().vertices_m.copy()
    vertices[2] *= 3.0
    write_stored_states(file, replace(lying(), vertices_m=vertices))
    with pytest.raises(ValueError, match="state shifted 1: expected a sound cloth; got overstret"):
        make("HandkerchiefFlip36", spacing_m=SPACING_M, stored_states=str(file))


def test_what_is_not_stored_is_refused(file: Path, tmp_path: Path) -> None:
    env = make("HandkerchiefFlip36", spacing_m=SPACING_M, stored_states=str(file))
    with pytest.raises(ValueError, match="expected one of shifted, flat, which are stored; got"):
        env.reset(options={"initial_state": "creased"})
    for index in (1, -1, "first"):
        with pytest.raises(ValueError, match="stored_index: expected an integer from 0 to 0; got"):
            env.reset(options={"stored_index": index})
    with pytest.raises(ValueError, match="stored_index: expected none without stored states"):
        make("HandkerchiefFlip36").reset(options={"stored_index": 0})
    with pytest.raises(ValueError, match=r"or one of handkerchief, shirt, trousers; got 'socks'"):
        read_stored_states("socks")
    with pytest.raises(ValueError, match="No such file"):
        read_stored_states(str(tmp_path / "none.npz"))
    with pytest.raises(ValueError, match=r"output: expected a file that ends in \.npz"):
        write_stored_states(tmp_path / "states.zip", lying())
