"""A slice is a recording by itself, with all that belongs to what was asked for."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader

from broker_config.codec import SCHEMA_VERSION, decode_any
from broker_config.errors import StorageError
from broker_config.messages import (
    JournalEntry,
    Metrics,
    RecorderStarted,
    Rewards,
    RunStarted,
    Snapshot,
    SnapshotTaken,
    TicketIssued,
    Trajectory,
    View,
)
from broker_config.recording.check import RecordingCheck
from broker_config.recording.format import segment_path
from broker_config.recording.reader import read_excerpt
from broker_config.recording.recording import RecordedMessage, Recording, iter_recording
from broker_config.recording.slice import slice_recording
from broker_config.recording.slice_plan import Selection
from deploy.presets import load_preset
from tests.synthetic_recording import RUN, Heard, SyntheticRun, record

PRESET = load_preset("imitation-smoke", ["schedule.iterations=3", "task.horizon=2"])
NS = 1_000_000_000


@pytest.fixture(scope="module")
def heard() -> list[Heard]:
    return list(SyntheticRun(PRESET, weights_bytes=300).messages())


@pytest.fixture
def recording(tmp_path: Path, heard: list[Heard], monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording of several segments, with a message each second."""
    clock = iter(range(10_000 * NS, 20_000 * NS, NS))
    monkeypatch.setattr("broker_config.recording.segment.time.time_ns", lambda: next(clock))
    folder = tmp_path / "recording"
    record(folder, heard, segment_bytes=150_000)
    assert len(list(folder.glob("*.mcap"))) > 2
    return folder


def messages(folder: Path) -> list[object]:
    return [item.decode() for item in iter_recording(folder) if item.encoding == "msgpack"]


def contents(folder: Path) -> list[object]:
    """Messages, and of journal entries what is in them."""
    return [
        decode_any(it.payload) if isinstance(it, JournalEntry) else it for it in messages(folder)
    ]


def faults(path: Path) -> list[str]:
    return [it.text for it in RecordingCheck(path).findings() if it.is_fault]


def topics(folder: Path) -> set[str]:
    return {item.topic for item in iter_recording(folder)}


def test_an_episode_comes_with_its_ticket_its_policy_and_its_views(
    recording: Path, tmp_path: Path
) -> None:
    before = {path.name: path.read_bytes() for path in recording.iterdir()}
    sliced = slice_recording(recording, tmp_path / "new", Selection(episodes=range(4, 5)))
    assert {path.name: path.read_bytes() for path in recording.iterdir()} == before
    found = contents(tmp_path / "new")
    assert isinstance(found[0], RecorderStarted)
    assert [type(it).__name__ for it in found if not isinstance(it, View)] == [
        "RecorderStarted",
        "RunStarted",
        "Snapshot",
        "SnapshotTaken",
        "TicketIssued",
        "Trajectory",
        "AttemptEnded",
    ]
    versions = {it.version for it in found if isinstance(it, Snapshot | SnapshotTaken)}
    (ticket,) = (it.ticket for it in found if isinstance(it, TicketIssued))
    assert versions == {ticket.policy_version} == {1}
    assert [it.step for it in found if isinstance(it, View)] == [0, 1, 2]
    assert {it.ticket for it in found if isinstance(it, View)} == {4}
    images = [it for it in iter_recording(tmp_path / "new") if it.topic == "view/actor-0/image"]
    assert len(images) == 3
    assert (sliced.trajectories, sliced.entries, sliced.segments) == (1, 5, 1)
    assert faults(tmp_path / "new") == []


def test_iterations_come_with_their_rewards_and_what_was_measured(
    recording: Path, tmp_path: Path
) -> None:
    slice_recording(recording, tmp_path / "new", Selection(iterations=range(1, 3)))
    found = contents(tmp_path / "new")
    assert [it.iteration for it in found if isinstance(it, Rewards)] == [1, 2]
    episodes = [it.ticket.index for it in found if isinstance(it, Trajectory)]
    assert episodes == list(range(3, 9))
    assert [it.version for it in found if isinstance(it, Snapshot)] == [1, 2]
    assert [it.sequence for it in found if isinstance(it, Metrics)] == [1]
    assert sum(isinstance(it, RunStarted) for it in found) == 1
    assert faults(tmp_path / "new") == []


def test_a_time_comes_with_the_tickets_and_policies_of_what_ended_in_it(
    recording: Path, tmp_path: Path
) -> None:
    source = list(iter_recording(recording))
    began_ns = source[0].log_time_ns
    (ended,) = (it for it in source if _holds_trajectory(it, 5))
    at_secs = (ended.log_time_ns - began_ns) / NS
    selection = Selection(secs=(at_secs, at_secs + 2))
    slice_recording(recording, tmp_path / "new", selection)
    found = contents(tmp_path / "new")
    assert [it.ticket.index for it in found if isinstance(it, Trajectory)] == [5]
    assert [it.ticket.index for it in found if isinstance(it, TicketIssued)] == [5]
    assert [it.version for it in found if isinstance(it, Snapshot)] == [1]
    assert [it for it in found if isinstance(it, View)] == []
    assert faults(tmp_path / "new") == []


def _holds_trajectory(item: RecordedMessage, index: int) -> bool:
    if item.topic != "journal/trajectory":
        return False
    entry = item.decode()
    assert isinstance(entry, JournalEntry)
    trajectory = decode_any(entry.payload)
    assert isinstance(trajectory, Trajectory)
    return trajectory.ticket.index == index


def test_all_of_the_time_is_all_of_the_recording(recording: Path, tmp_path: Path) -> None:
    slice_recording(
        recording, tmp_path / "new", Selection(secs=(0.0, float("inf"))), lambda _: None
    )
    starts = [it for it in messages(recording) if isinstance(it, RecorderStarted)]
    assert messages(tmp_path / "new")[1:] == [it for it in messages(recording) if it not in starts]
    originals = [it for it in iter_recording(recording) if it.topic != "recorder"]
    copies = [it for it in iter_recording(tmp_path / "new") if it.topic != "recorder"]
    assert copies == originals, "times and sequence numbers too"
    assert faults(tmp_path / "new") == []


def test_topics_are_chosen(recording: Path, tmp_path: Path) -> None:
    slice_recording(recording, tmp_path / "tickets", Selection(topics=("journal/ticket",)))
    assert topics(tmp_path / "tickets") == {"journal/ticket", "recorder"}
    by_both = Selection(episodes=range(2), topics=("view/", "journal/"))
    slice_recording(recording, tmp_path / "both", by_both)
    assert "snapshot" not in topics(tmp_path / "both")
    assert {"view/actor-0", "view/actor-0/image", "journal/run"} <= topics(tmp_path / "both")
    assert faults(tmp_path / "tickets") == faults(tmp_path / "both") == []


def test_a_slice_says_what_it_is_of_and_no_recorder_goes_on_with_it(
    recording: Path, tmp_path: Path
) -> None:
    slice_recording(recording, tmp_path / "new", Selection(episodes=range(2, 4), topics=("view/",)))
    excerpt = read_excerpt(segment_path(tmp_path / "new", 0))
    assert excerpt is not None
    assert (excerpt.kind, excerpt.part) == ("slice", "episodes 2-3; topics view/")
    assert excerpt.source == f"{tmp_path.name}/recording"
    with pytest.raises(StorageError, match="that a recorder wrote; got a slice of"):
        Recording(tmp_path / "new", RUN, "rec-2")


def test_a_slice_may_have_many_segments_and_be_cut_again(tmp_path: Path) -> None:
    recording, everything = tmp_path / "large", Selection(secs=(0.0, float("inf")))
    record(recording, SyntheticRun(PRESET, weights_bytes=1_100_000).messages())
    sliced = slice_recording(recording, tmp_path / "new", everything, segment_bytes=100_000)
    assert sliced.segments > 2
    for path in sorted((tmp_path / "new").iterdir()):
        first = next(iter_recording(path)).decode()
        assert isinstance(first, RecorderStarted)
        with path.open("rb") as file:
            assert make_reader(file, validate_crcs=True).get_summary() is not None
    assert faults(tmp_path / "new") == []
    slice_recording(tmp_path / "new", tmp_path / "again", Selection(episodes=range(3, 5)))
    assert faults(tmp_path / "again") == []
    (path, *_) = sorted((tmp_path / "new").iterdir())
    path.unlink()
    assert faults(tmp_path / "new")


def test_what_is_not_there_is_refused_and_nothing_is_left(recording: Path, tmp_path: Path) -> None:
    new = tmp_path / "new"
    with pytest.raises(StorageError, match="expected episodes 90-98 in the recording; got none of"):
        slice_recording(recording, new, Selection(episodes=range(90, 99)))
    with pytest.raises(StorageError, match="got none of them; it has episodes 0 to 8 in"):
        slice_recording(recording, new, Selection(iterations=range(7, 8)))
    with pytest.raises(StorageError, match="expected messages of topics nonsense; got none"):
        slice_recording(recording, new, Selection(topics=("nonsense",)))
    assert [it.name for it in tmp_path.iterdir()] == ["recording"]


def test_nothing_is_overwritten(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "file").write_bytes(b"mine")
    (tmp_path / "new.partial").mkdir()
    (tmp_path / "new.partial" / "mine").write_bytes(b"mine")
    for name in ("there", "file", "new", "recording"):
        with pytest.raises(StorageError, match="expected nothing there"):
            slice_recording(recording, tmp_path / name, Selection(episodes=range(1)))
    assert (tmp_path / "file").read_bytes() == b"mine"
    assert (tmp_path / "new.partial" / "mine").read_bytes() == b"mine"
    assert list((tmp_path / "there").iterdir()) == []


def test_a_damaged_or_unfinished_recording_is_refused(recording: Path, tmp_path: Path) -> None:
    path = segment_path(recording, 1)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(StorageError, match=r"is cut off after .*; `clothbus recover` copies"):
        slice_recording(recording, tmp_path / "new", Selection(episodes=range(9)))
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    path.write_bytes(flipped)
    with pytest.raises(StorageError, match="expected a sound segment; got a chunk"):
        slice_recording(recording, tmp_path / "new", Selection(episodes=range(9)))
    path.unlink()
    with pytest.raises(StorageError, match=r"expected segment 000001\.mcap after 000000\.mcap"):
        slice_recording(recording, tmp_path / "new", Selection(episodes=range(9)))
    assert [it.name for it in tmp_path.iterdir()] == ["recording"]


def test_another_schema_version_is_refused(
    tmp_path: Path, heard: list[Heard], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("broker_config.recording.segment.SCHEMA_VERSION", 1)
        record(tmp_path / "older", heard[:4])
    rule = f"expected schema version {SCHEMA_VERSION}, which this clothbus reads; got 1"
    with pytest.raises(StorageError, match=rule):
        slice_recording(tmp_path / "older", tmp_path / "new", Selection(episodes=range(1)))
