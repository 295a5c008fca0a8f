"""`clothbus info`, `check`, `recover` and `slice`, as they are typed."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from broker_config.codec import SCHEMA_VERSION
from broker_config.recording.format import segment_path
from deploy import cli
from deploy.byte_progress import byte_progress
from deploy.presets import load_preset
from tests.synthetic_recording import RUN, SyntheticRun, journal, record

PRESET = load_preset("imitation-smoke", ["schedule.iterations=2", "task.horizon=2"])

Clothbus = Callable[..., tuple[int, str, str]]


@pytest.fixture
def clothbus(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Clothbus:
    """Runs a command in this process: exit code, what it printed, what it complained of."""
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["clothbus", *map(str, arguments)])
        try:
            cli.main()
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        out, err = capsys.readouterr()
        return code, out, err

    return run


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """A run folder with a journal and its recording of several segments."""
    folder = tmp_path / "run"
    folder.mkdir()
    heard = list(SyntheticRun(PRESET).messages())
    record(folder / "recording", heard, segment_bytes=150_000)
    journal(folder / "journal.sqlite", heard)
    return folder


def test_info_says_what_is_in_a_recording(clothbus: Clothbus, run_folder: Path) -> None:
    code, out, _ = clothbus("info", run_folder)
    assert code == 0
    for words in (RUN, "imitation-smoke", "owner/learner", "journal/trajectory", "000001.mcap"):
        assert words in out
    assert "3, from 0 to 2" in out
    code, out, _ = clothbus("info", run_folder / "recording", "--json")
    found = json.loads(out)
    assert (found["run"], found["preset"], found["preset_digest"]) == (
        RUN,
        PRESET.name,
        PRESET.digest,
    )
    assert found["topics"]["journal/rewards"]["count"] == 2
    assert found["topics"]["journal/run"] == {
        "message": "JournalEntry",
        "schema_version": SCHEMA_VERSION,
        "count": 1,
        "first_offset": 0,
        "last_offset": 0,
    }
    entries = sum(
        it["count"] for topic, it in found["topics"].items() if topic.startswith("journal/")
    )
    assert max(it["last_offset"] or 0 for it in found["topics"].values()) == entries - 1
    assert found["topics"]["view/actor-0/image"]["message"] == "foxglove.CompressedImage"
    assert found["snapshots"] == [0, 1, 2]
    assert found["processes"] == {"actor/actor-0": 1, "owner/learner": 1}
    assert sum(it["messages"] for it in found["segments"]) == found["messages"]


def test_info_of_a_recording_that_is_still_written(clothbus: Clothbus, run_folder: Path) -> None:
    _, out, _ = clothbus("info", run_folder, "--json")
    whole = json.loads(out)
    *_, last = sorted((run_folder / "recording").glob("*.mcap"))
    last.write_bytes(last.read_bytes()[:-40])  # its index, as a killed recorder leaves it
    code, out, _ = clothbus("info", run_folder, "--json")
    torn = json.loads(out)
    assert code == 0
    assert [it["is_finished"] for it in torn["segments"]][-2:] == [True, False]
    for name in ("messages", "topics", "snapshots", "processes", "run", "preset", "gaps"):
        assert torn[name] == whole[name], name
    last.write_bytes(b"")
    code, out, _ = clothbus("info", run_folder)
    assert code == 0
    assert "not finished" in out


def test_info_of_another_schema_version_shows_what_the_index_says(
    clothbus: Clothbus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("broker_config.recording.segment.SCHEMA_VERSION", 7)
        record(tmp_path / "newer", list(SyntheticRun(PRESET).messages())[:5])
    code, out, _ = clothbus("info", tmp_path / "newer")
    assert code == 0
    assert f"7; this clothbus reads {SCHEMA_VERSION}" in out
    assert "journal/run" in out
    code, _, err = clothbus("check", tmp_path / "newer")
    assert code == 3
    assert f"expected schema version {SCHEMA_VERSION}, which this clothbus reads; got 7" in err


def test_check_says_whether_a_recording_is_whole(clothbus: Clothbus, run_folder: Path) -> None:
    code, out, err = clothbus("check", run_folder, "--against", run_folder)
    assert (code, out.splitlines()[-1].split(";")[0]) == (0, f"{run_folder}/recording: whole")
    assert err == "", "a bar is for terminals"
    path = segment_path(run_folder / "recording", 1)
    file = bytearray(path.read_bytes())
    file[len(file) // 2] ^= 4
    path.write_bytes(file)
    code, out, _ = clothbus("check", run_folder)
    assert code == 1
    assert "000001.mcap, bytes" in out
    assert "not whole" in out.splitlines()[-1]
    assert path.read_bytes() == file


def test_a_bar_is_drawn_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    with byte_progress("checking", 2000) as on_bytes:
        on_bytes(1000)
    out, err = capsys.readouterr()
    assert out == ""
    assert "checking" in err
    assert "/2.0 kB" in err


def test_recover_then_slice(clothbus: Clothbus, run_folder: Path, tmp_path: Path) -> None:
    path = segment_path(run_folder / "recording", 1)
    path.write_bytes(path.read_bytes()[:-1000])
    code, _, err = clothbus("slice", run_folder, "--output", tmp_path / "part", "--episodes", "1")
    assert code == 3
    assert "clothbus recover" in err
    code, out, _ = clothbus("recover", path, "--output", tmp_path / "new.mcap")
    assert code == 0
    assert "kept" in out
    assert "cut off: 000001.mcap, bytes" in out
    assert clothbus("info", tmp_path / "new.mcap")[0] == 0
    code, _, err = clothbus("recover", path, "--output", tmp_path / "new.mcap")
    assert code == 3
    assert "expected nothing there; got a file" in err
    path.unlink()
    (tmp_path / "new.mcap").rename(path)
    code, out, _ = clothbus("slice", run_folder, "--output", tmp_path / "part", "--episodes", "1-2")
    assert code == 0
    assert "2 trajectories" in out
    assert clothbus("check", tmp_path / "part", "--against", run_folder)[0] == 0


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["info", "nowhere"], "expected a recording's folder, a run folder or a .mcap file"),
        (["check", "nowhere"], "expected a recording's folder, a run folder or a .mcap file"),
        (["check", ".", "--against", "."], "expected"),
        (["info", "."], "expected segments like 000000.mcap; got none"),
        (["info", "foreign.mcap"], "expected a segment of a clothbus recording; got another"),
        (["recover", "foreign.mcap", "--output", "new"], "got another file"),
        (["recover", "empty.mcap", "--output", "new"], "expected at least one whole message"),
        (["recover", ".", "--output", "new"], "expected a .mcap file; got a folder"),
        (["slice", "foreign.mcap", "--output", "new", "--episodes", "1"], "got another file"),
        (["slice", "empty.mcap", "--output", "new", "--episodes", "1"], "cut off after 0 bytes"),
        (["slice", ".", "--output", "new"], "slice: expected one of --from-secs and --to-secs"),
        (["slice", ".", "--output", "new", "--episodes", "5-3"], "a range like 3-7; got 5-3"),
        (
            ["slice", ".", "--output", "new", "--episodes", "1", "--iterations", "1"],
            "got episodes 1; iterations 1",
        ),
        (["slice", ".", "--output", "new", "--from-secs", "5", "--to-secs", "2"], "got 5 and 2"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line_and_changes_nothing(
    clothbus: Clothbus,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    complaint: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "foreign.mcap").write_bytes(b"something else entirely, and long enough " * 20)
    (tmp_path / "empty.mcap").write_bytes(b"")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    code, out, err = clothbus(*arguments)
    assert (code, out) == (3, "")
    assert err.startswith("clothbus: ")
    assert complaint in err
    assert err.count("\n") == 1
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
