"""Run folders: named for keys, never mixed up."""

from __future__ import annotations

from pathlib import Path

import pytest

from broker_config.errors import PresetError, StorageError
from broker_config.messages import require_id
from deploy.presets import load_preset, preset_names
from deploy.run_folder import RunFolder, create_run_folder, prepare_run_folder


def test_every_preset_s_folder_name_can_be_a_key(tmp_path: Path) -> None:
    for name in preset_names():
        folder = create_run_folder(tmp_path, load_preset(name))
        assert require_id("run", folder.run) == folder.run


def test_two_runs_in_one_second_have_two_folders(tmp_path: Path) -> None:
    preset = load_preset("reaching-smoke")
    paths = {create_run_folder(tmp_path, preset).path for _ in range(3)}
    assert len(paths) == 3


def test_the_preset_comes_back_as_it_was(tmp_path: Path) -> None:
    preset = load_preset("handkerchief-ch3", ["seed=4"])
    assert create_run_folder(tmp_path, preset).read_preset() == preset


def test_a_folder_of_another_preset_is_refused(tmp_path: Path) -> None:
    prepare_run_folder(tmp_path / "run", load_preset("reaching-smoke"))
    prepare_run_folder(tmp_path / "run", load_preset("reaching-smoke"))
    with pytest.raises(StorageError, match="expected a run of preset reaching-smoke"):
        prepare_run_folder(tmp_path / "run", load_preset("reaching-smoke", ["seed=1"]))


def test_what_is_no_run_folder_is_said_so(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="expected a run folder"):
        RunFolder(tmp_path).read_preset()


def test_an_unknown_preset_is_refused_with_the_known_ones() -> None:
    with pytest.raises(PresetError, match="handkerchief-quickstart"):
        load_preset("handkerchief")
