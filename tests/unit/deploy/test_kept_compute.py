"""A run is trained to its end by the path that it was begun with."""

from __future__ import annotations

from pathlib import Path

import pytest

from broker_config.errors import StorageError
from deploy.run_folder import RunFolder
from deploy.running.kept_compute import settle_compute
from learner.steps.compute import Compute


def test_a_run_goes_on_by_the_path_that_it_was_begun_with(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    assert settle_compute(folder, Compute(path="reference")).path == "reference"
    assert settle_compute(folder, Compute()).path == "reference", "nothing else is asked for"
    assert settle_compute(folder, Compute(path="reference")).path == "reference"
    with pytest.raises(StorageError, match=r"go on by reference steps on cpu.*got winograd"):
        settle_compute(folder, Compute(path="winograd"))
    with pytest.raises(StorageError, match=r"got graphs steps on cuda.*remove .*compute.txt"):
        settle_compute(folder, Compute("cuda"))
    folder.compute.unlink()
    assert settle_compute(folder, Compute()) == Compute(path=Compute().chosen_path)
    assert folder.compute.read_text() == f"{Compute()}\n"


@pytest.mark.parametrize("begun", ["products-bf16 steps on cpu", "winograd steps on cpu"])
def test_arithmetic_that_this_version_does_not_have_is_said(tmp_path: Path, begun: str) -> None:
    folder = RunFolder(tmp_path)
    folder.compute.write_text(f"{begun}\n")
    with pytest.raises(StorageError, match=rf"{begun}.*got a version of clothbus without it"):
        settle_compute(folder, Compute())


def test_what_cannot_be_kept_is_said(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.compute.mkdir()
    with pytest.raises(StorageError, match="expected to keep how the run is trained"):
        settle_compute(folder, Compute())
