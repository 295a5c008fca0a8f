"""`clothbus demos`: make, show and label, as a person calls them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from broker_config.errors import PresetError, StorageError
from broker_config.recording.recording import Recording
from deploy.cli import app
from deploy.commands.demonstrations import label, make, show
from deploy.demonstrations.demonstrators import by_script
from deploy.demonstrations.making import make_demonstrations
from deploy.presets import load_preset
from learner.recorded import read_demonstrations

Capture = pytest.CaptureFixture[str]

ORANGE = (225, 90, 0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three episodes of ten steps, none of which gets there."""
    preset = load_preset("reaching-smoke")
    make_demonstrations(preset, tmp_path / "demos", 3, by_script(preset, 0.2))
    return tmp_path / "demos"


def marks(folder: Path) -> dict[int, list[int]]:
    read = read_demonstrations(folder)
    numbers = {each.id: number for number, each in enumerate(read.trajectories)}
    return {numbers[mark.trajectory]: list(mark.states) for mark in read.marks or ()}


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.mcap")}


def test_the_command_line_has_all_three(tmp_path: Path, capsys: Capture) -> None:
    folder = tmp_path / "demos"
    options = ["--episodes", "2", "--mistakes", "0.5", "--set", "task.horizon=4"]
    app.cli(args=["demos", "make", "reaching-smoke", "--output", str(folder), *options])
    assert (
        "2 episodes, 8 samples, 0 target states (last states of success" in capsys.readouterr().out
    )
    app.cli(args=["demos", "label", str(folder), "--targets", "0:2-3", "1:4"])
    assert "3 target states marked in 2 episodes" in capsys.readouterr().out
    app.cli(args=["demos", "show", str(folder)])
    shown = capsys.readouterr().out
    assert "the script, 0.5 of its actions random" in shown
    assert "2-3" in shown


def test_cloth_is_demonstrated_and_shown(tmp_path: Path, capsys: Capture) -> None:
    folder, sheet = tmp_path / "demos", tmp_path / "new" / "sheet.png"
    make("shirt-ch4", folder, episodes=2, settings=("task.options.spacing_m=0.05",))
    show(folder, sheet)
    targets = np.sum([each.success for each in read_demonstrations(folder).trajectories])
    assert f"{targets} target states" in capsys.readouterr().out
    with Image.open(sheet) as picture:
        assert picture.size == (84 + 4 * (168 + 8), 8 + 2 * (168 + 13 + 8))


def test_a_target_is_framed_where_its_state_is(folder: Path, tmp_path: Path) -> None:
    def framed() -> list[tuple[int, int]]:
        show(folder, tmp_path / "sheet.png")
        with Image.open(tmp_path / "sheet.png") as picture:
            return [
                (episode, state)
                for episode in range(3)
                for state in range(11)
                if picture.getpixel((84 + state * 92 - 2, 8 + episode * 105 + 50)) == ORANGE
            ]

    assert framed() == []
    label(folder, ("0:3,9-10", "2:1"))
    assert framed() == [(0, 3), (0, 9), (0, 10), (2, 1)]


def test_the_last_word_for_an_episode_counts(folder: Path, capsys: Capture) -> None:
    label(folder, ("0:8-10", "1:10"))
    assert marks(folder) == {0: [8, 9, 10], 1: [10]}
    label(folder, ("1:2", "1:4-5", "2:7"))
    assert marks(folder) == {0: [8, 9, 10], 1: [2, 4, 5], 2: [7]}
    show(folder)
    assert "marked by a person" in capsys.readouterr().out
    label(folder, ("2:7",), clear=True)
    assert marks(folder) == {2: [7]}
    before = contents(folder)
    label(folder, ("2:7",))
    assert contents(folder) == before, "nothing new was said"
    label(folder, clear=True)
    assert read_demonstrations(folder).marks is None
    show(folder)
    assert "last states of successes" in " ".join(capsys.readouterr().out.split())


def test_what_is_marked_stays_when_more_is_made_and_is_never_drawn_anew(folder: Path) -> None:
    label(folder, ("1:2-4",))
    make("reaching-smoke", folder, episodes=4, mistakes=0.2, least_targets=40)
    assert len(read_demonstrations(folder).trajectories) == 4
    assert marks(folder) == {1: [2, 3, 4]}


@pytest.mark.parametrize(
    ("targets", "complaint"),
    [
        (("0:1", "3:1"), "expected an episode of the 3, counted from 0; got 3"),
        (("0:1", "1:10-11"), "expected states 1 to 10 of episode 1; got 10, 11"),
        (("0:0",), "expected states from 1 on, the lower first; got 0"),
        (("0:5-3",), "expected states from 1 on, the lower first; got 5-3"),
        (("0:",), "expected EPISODE:STATES; got something else"),
        (("last:3",), "expected EPISODE:STATES; got something else"),
        ((), "expected --targets or --clear; got neither"),
    ],
)
def test_what_is_not_there_cannot_be_marked_and_nothing_is_written(
    folder: Path, targets: tuple[str, ...], complaint: str
) -> None:
    before = contents(folder)
    with pytest.raises(PresetError, match=complaint):
        label(folder, targets)
    assert contents(folder) == before


def test_marks_that_were_being_written_are_all_there_or_none(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cut off at any byte, as a kill or a full disk would."""
    label(folder, ("0:8-10", "1:10"))
    segment = folder / "000001.mcap"
    whole, outcomes = segment.read_bytes(), []
    for size in range(0, len(whole), 40):
        segment.write_bytes(whole[:size])
        label(folder, ("2:1",))
        outcomes.append(marks(folder))
        for path in sorted(folder.glob("*.mcap"))[1:]:
            path.unlink()
    assert {2: [1]} in outcomes
    assert {0: [8, 9, 10], 1: [10], 2: [1]} in outcomes
    assert all(it in ({2: [1]}, {0: [8, 9, 10], 1: [10], 2: [1]}) for it in outcomes)


def test_only_demonstrations_are_labelled(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="expected a folder of `clothbus demos make`; got none"):
        label(tmp_path / "nowhere", ("0:1",))
    assert not (tmp_path / "nowhere").exists()
    with Recording(tmp_path, "run", "rec-1") as recording:
        recording.finish()
    with pytest.raises(StorageError, match="expected one of run demonstrations; got one of run"):
        label(tmp_path, ("0:1",))


def test_what_cannot_be_drawn_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(PresetError, match=r"expected a file that ends in \.png"):
        show(folder, tmp_path / "sheet.gif")


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"episodes": 0}, "--episodes: expected at least 1; got 0"),
        ({"least_targets": -1}, "--least-targets: expected at least 0; got -1"),
        ({"mistakes": 0.1, "demonstrator": "random"}, "with the scripted demonstrator alone"),
        ({"quality": 0.5, "demonstrator": "random"}, "with the scripted demonstrator alone"),
        ({"quality": 0.5, "mistakes": 0.1}, "expected --mistakes or --quality; got both"),
        ({"demonstrator": "policy"}, "exactly with --demonstrator policy; got run None"),
        ({"run": Path("r")}, "exactly with --demonstrator policy; got run r"),
        ({"version": 3}, "exactly with --demonstrator policy; got run None, version 3"),
    ],
)
def test_options_that_contradict_each_other_are_refused(
    options: dict[str, object], complaint: str, tmp_path: Path
) -> None:
    with pytest.raises(PresetError, match=complaint):
        make("reaching-smoke", tmp_path / "demos", **options)  # type: ignore[arg-type]
    assert not (tmp_path / "demos").exists()
