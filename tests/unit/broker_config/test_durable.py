"""Folders are whole or not there."""

from __future__ import annotations

from pathlib import Path

import pytest

from broker_config.durable import new_folder
from broker_config.errors import StorageError


def fill(path: Path, error: BaseException | None = None) -> None:
    with new_folder(path) as folder:
        (folder / "inner").mkdir()
        (folder / "inner" / "file").write_text("content")
        if error is not None:
            raise error


def test_a_folder_has_its_name_once_it_is_full(tmp_path: Path) -> None:
    with new_folder(tmp_path / "deep" / "out") as folder:
        (folder / "file").write_text("content")
        assert not (tmp_path / "deep" / "out").exists()
    assert (tmp_path / "deep" / "out" / "file").read_text() == "content"
    assert [it.name for it in (tmp_path / "deep").iterdir()] == ["out"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("no")])
def test_what_fails_leaves_nothing(tmp_path: Path, error: BaseException) -> None:
    with pytest.raises(type(error)):
        fill(tmp_path / "out", error)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_said_in_words(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"expected a disk that can be written; got .*space"):
        fill(tmp_path / "out", OSError(28, "No space left on device"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["out", "out.partial"])
def test_nothing_that_is_there_is_touched(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    with pytest.raises(StorageError, match=f"{name}: expected a folder that is not there yet"):
        fill(tmp_path / "out")
    assert [it.name for it in tmp_path.rglob("*")] == [name]
