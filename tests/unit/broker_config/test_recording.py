"""Recordings: what is written is read, and what a killed recorder leaves is mended, not lost."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from broker_config.errors import AlreadyOwned, StorageError
from broker_config.messages import (
    JournalEntry,
    Metrics,
    Presence,
    RecorderStarted,
    RecordingGap,
    Snapshot,
    View,
    weights_digest,
)
from broker_config.recording.recording import (
    RecordedMessage,
    Recording,
    iter_recording,
    lock_recording,
)
from broker_config.specs import NetworkSpec

PICTURE = b"\x89PNG of sorts"


def entry(offset: int, size: int = 200, sort: str = "ended") -> JournalEntry:
    payload = np.random.default_rng(offset).bytes(size)
    return JournalEntry(offset, f"{sort}/a/life/{offset}", payload, 1.5e9 + offset)


def snapshot(version: int, size: int = 300) -> Snapshot:
    weights = np.random.default_rng(version).bytes(size)
    spec = NetworkSpec((84, 84, 1), 10, "plain", 0.5)
    return Snapshot(version, 1, spec, weights, weights_digest(weights))


def view(sequence: int, incarnation: str = "life") -> View:
    return View("actor-0", incarnation, sequence, 0, 0, 0, 0, None, None, PICTURE, "png", 1.5e9)


def metrics(sequence: int, incarnation: str = "life") -> Metrics:
    return Metrics("owner", "learner", incarnation, sequence, 1, {"loss": 0.5})


def record(folder: Path, life: str = "rec-1", segment_bytes: int = 1 << 30) -> Recording:
    folder.mkdir(exist_ok=True)
    return Recording(folder, "run", life, segment_bytes)


def messages(folder: Path, *topics: str) -> list[object]:
    found = iter_recording(folder, topics or None)
    return [item.decode() for item in found if item.encoding == "msgpack"]


def offsets(folder: Path) -> list[int]:
    found = messages(folder, "journal/")
    assert all(
        isinstance(it, JournalEntry) and it == entry(it.offset, len(it.payload)) for it in found
    )
    return [it.offset for it in found if isinstance(it, JournalEntry)]


def write(folder: Path, *, is_finished: bool) -> list[tuple[int, int]]:
    """Records twelve entries in five chunks; returns size and held offset after each flush."""
    flushed = []
    with record(folder) as recording:
        for offset in range(12):
            recording.add_live(view(offset))
            recording.add_entry(entry(offset))
            if offset % 3 == 2:
                recording.flush()
                flushed.append((segment(folder).stat().st_size, recording.held_offset))
        if is_finished:
            recording.finish()
    return flushed


def segment(folder: Path, number: int = 0) -> Path:
    return folder / f"{number:06d}.mcap"


def with_segment(folder: Path, content: bytes) -> Path:
    folder.mkdir()
    segment(folder).write_bytes(content)
    return folder


# What is written is read -----------------------------------------------------------------------


def test_messages_come_back_in_the_order_in_which_they_were_written(tmp_path: Path) -> None:
    said = [entry(0), view(0), snapshot(0), metrics(0), Presence("actor", "actor-0", True)]
    with record(tmp_path) as recording:
        recording.add_entry(said[0])
        recording.add_live(said[1])
        recording.add_snapshot(said[2])
        recording.add_live(said[3])
        recording.add_live(said[4])
        recording.finish()
    first, *rest = messages(tmp_path)
    assert isinstance(first, RecorderStarted)
    assert (first.run, first.incarnation, first.next_offset) == ("run", "rec-1", 0)
    assert rest == said
    topics = [item.topic for item in iter_recording(tmp_path)]
    assert topics == [
        "recorder",
        "journal/ended",
        "view/actor-0",
        "view/actor-0/image",
        "view/actor-0/annotations",
        "snapshot",
        "metrics/owner/learner",
        "metrics/owner/learner/loss",
        "presence",
    ]


def test_times_and_sequence_numbers_are_those_of_the_origin(tmp_path: Path) -> None:
    with record(tmp_path) as recording:
        recording.add_entry(entry(0))
        recording.add_entry(entry(1))
        recording.finish()
    items = list(iter_recording(tmp_path, ["journal/ended"]))
    assert [item.sequence for item in items] == [0, 1]
    assert [item.publish_time_ns for item in items] == [
        1_500_000_000 * 10**9,
        1_500_000_001 * 10**9,
    ]
    assert all(abs(item.log_time_ns - time.time_ns()) < 600 * 10**9 for item in items)


def test_topics_are_chosen_one_by_one_or_by_their_beginning(tmp_path: Path) -> None:
    write(tmp_path, is_finished=True)

    def topics(*chosen: str) -> set[str]:
        return {item.topic for item in iter_recording(tmp_path, chosen)}

    assert topics("view/actor-0") == {"view/actor-0"}
    shown = {"view/actor-0/image", "view/actor-0/annotations"}
    assert topics("view/") == {"view/actor-0", *shown}
    assert topics("journal/", "recorder") == {"journal/ended", "recorder"}
    assert topics("journal") == set()


def test_entries_are_taken_in_order_and_once(tmp_path: Path) -> None:
    with record(tmp_path) as recording:
        recording.add_entry(entry(0))
        for wrong in (entry(0), entry(2)):
            with pytest.raises(StorageError, match=f"expected journal entry 1; got {wrong.offset}"):
                recording.add_entry(wrong)


def test_a_clock_that_jumps_backwards_does_no_harm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter(range(10**18, 0, -(10**14)))
    monkeypatch.setattr("broker_config.recording.segment.time.time_ns", lambda: next(clock))
    write(tmp_path, is_finished=True)
    assert offsets(tmp_path) == list(range(12))
    times = [item.log_time_ns for item in iter_recording(tmp_path)]
    assert times == sorted(times, reverse=True)
    with record(tmp_path, "rec-2") as recording:
        assert recording.next_offset == 12


def test_held_is_what_was_flushed(tmp_path: Path) -> None:
    with record(tmp_path) as recording:
        recording.add_entry(entry(0))
        assert (recording.next_offset, recording.held_offset) == (1, 0)
        recording.flush()
        assert (recording.held_offset, recording.unflushed_bytes) == (1, 0)


# Segments --------------------------------------------------------------------------------------


def test_a_full_segment_is_finished_and_the_next_goes_on(tmp_path: Path) -> None:
    with record(tmp_path, segment_bytes=20_000) as recording:
        for offset in range(40):
            recording.add_entry(entry(offset, 2000))
            recording.add_live(metrics(offset))
            recording.flush()
        recording.finish()
    paths = sorted(tmp_path.glob("*.mcap"))
    assert len(paths) > 3
    assert all(path.stat().st_size < 25_000 for path in paths)
    assert offsets(tmp_path) == list(range(40))
    for path in paths:
        first = next(iter_recording(path)).decode()
        assert isinstance(first, RecorderStarted)
        rest = list(iter_recording([path], ["journal/"]))
        assert first.next_offset == rest[0].sequence
    with record(tmp_path, "rec-2") as again:
        assert again.next_offset == 40
        again.add_live(metrics(40))
        again.finish()
    assert messages(tmp_path, "gap") == []


def test_a_finished_segment_is_left_as_it_is(tmp_path: Path) -> None:
    write(tmp_path, is_finished=True)
    before = segment(tmp_path).read_bytes()
    with record(tmp_path, "rec-2") as recording:
        recording.add_entry(entry(12))
        recording.finish()
    assert (tmp_path / "000000.mcap").read_bytes() == before
    assert offsets(tmp_path) == list(range(13))


def test_segments_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    write(tmp_path, is_finished=True)
    with pytest.raises(StorageError, match="expected one of run other; got one of run"):
        Recording(tmp_path, "other", "rec-2")
    for life in ("rec-2", "rec-3"):
        with record(tmp_path, life) as recording:
            recording.add_entry(entry(recording.next_offset))
            recording.finish()
    (tmp_path / "000001.mcap").rename(tmp_path / "kept")
    with pytest.raises(StorageError, match=r"expected segment 000001\.mcap after 000000\.mcap"):
        record(tmp_path, "rec-4")
    (tmp_path / "000002.mcap").rename(tmp_path / "000001.mcap")
    with pytest.raises(StorageError, match="expected to go on with journal entry 12; got 13"):
        record(tmp_path, "rec-4")


def test_only_one_recorder_has_a_folder(tmp_path: Path) -> None:
    with lock_recording(tmp_path), pytest.raises(AlreadyOwned, match="expected no other owner"):
        lock_recording(tmp_path)


# Killed recorders ------------------------------------------------------------------------------


def cuts(size: int) -> list[int]:
    """All places near the ends, and a net over the rest that meets every sort of record."""
    return sorted({*range(70), *range(70, size, 131), *range(size - 40, size + 1)})


@pytest.mark.parametrize("is_finished", [False, True], ids=["torn", "finished"])
def test_a_file_cut_off_anywhere_is_mended_and_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_finished: bool
) -> None:
    monkeypatch.setattr("os.fsync", lambda _: None)  # thousands of them; nobody cuts the power
    flushed = write(tmp_path / "whole", is_finished=is_finished)
    file = segment(tmp_path / "whole").read_bytes()
    found = set()
    for cut in cuts(len(file)):
        folder = with_segment(tmp_path / f"cut-{cut}", file[:cut])
        with record(folder, "rec-2") as recording:
            start = recording.next_offset
            held = max((offset for size, offset in flushed if size <= cut), default=0)
            assert start >= held, f"lost with a cut at {cut}"
            found.add(start)
            for offset in range(start, 13):
                recording.add_live(view(offset))
                recording.add_entry(entry(offset))
            recording.finish()
        assert offsets(folder) == list(range(13)), f"cut at {cut}"
        assert messages(folder, "gap") == [], f"cut at {cut}"
        assert not list(folder.glob("*.partial"))
    assert found == {0, 3, 6, 9, 12}


@pytest.mark.parametrize("is_finished", [False, True], ids=["torn", "finished"])
def test_a_damaged_file_is_read_whole_or_refused_and_then_not_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_finished: bool
) -> None:
    monkeypatch.setattr("os.fsync", lambda _: None)
    write(tmp_path / "whole", is_finished=is_finished)
    file = segment(tmp_path / "whole").read_bytes()
    refusals: list[str] = []
    for position in range(0, len(file), 19):
        flipped = bytearray(file)
        flipped[position] ^= 1 << (position % 8)
        folder = with_segment(tmp_path / f"flipped-{position}", flipped)
        try:
            with record(folder, "rec-2") as recording:
                assert recording.next_offset == 12, f"byte {position}"
                recording.finish()
            assert offsets(folder) == list(range(12)), f"byte {position}"
        except StorageError as refusal:
            refusals.append(str(refusal))
            assert segment(folder).read_bytes() == flipped, f"byte {position}"
    assert len(refusals) > 50
    assert all(f"{segment(tmp_path).name}: expected" in text for text in refusals)


def test_a_recorder_killed_while_it_mends_begins_again(tmp_path: Path) -> None:
    write(tmp_path, is_finished=False)
    torn = segment(tmp_path).read_bytes()
    # What a kill between the end of the copy and its new name leaves.
    partial = tmp_path / "000000.mcap.partial"
    partial.write_bytes(torn[: len(torn) // 2])
    with record(tmp_path, "rec-2") as recording:
        assert recording.next_offset == 12
        recording.finish()
    assert offsets(tmp_path) == list(range(12))
    assert not partial.exists()


def test_a_file_that_is_none_of_ours_is_refused_and_kept(tmp_path: Path) -> None:
    foreign = BytesIO()
    writer = Writer(foreign)
    writer.start()
    channel = writer.register_channel("chatter", "json", 0)
    writer.add_message(channel, 1, b"{}", 1)
    writer.finish()
    for content in (b"hello", b"h" * 1000, foreign.getvalue()):
        path = tmp_path / "000000.mcap"
        path.write_bytes(content)
        with pytest.raises(StorageError, match="expected a segment of a clothbus recording"):
            record(tmp_path)
        with pytest.raises(StorageError, match="expected a segment of a clothbus recording"):
            list(iter_recording(tmp_path))
        assert path.read_bytes() == content


def test_reading_says_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="expected segments like"):
        list(iter_recording(tmp_path))
    with pytest.raises(StorageError, match="expected a segment that can be read; got"):
        list(iter_recording(tmp_path / "nowhere.mcap"))
    write(tmp_path / "torn", is_finished=False)
    size = segment(tmp_path / "torn").stat().st_size
    with pytest.raises(StorageError, match=f"cut off after {size} bytes"):
        list(iter_recording(tmp_path / "torn"))
    (tmp_path / "000000.mcap").write_bytes(b"")
    with pytest.raises(StorageError, match="cut off after 0 bytes"):
        list(iter_recording(tmp_path))


def test_an_older_segment_that_is_torn_is_refused(tmp_path: Path) -> None:
    write(tmp_path, is_finished=False)
    (tmp_path / "000001.mcap").write_bytes(b"")
    with pytest.raises(StorageError, match=r"000000\.mcap: expected a finished segment"):
        record(tmp_path, "rec-2")


# Gaps ------------------------------------------------------------------------------------------


def test_what_was_dropped_is_marked_by_incarnation_and_once(tmp_path: Path) -> None:
    with record(tmp_path) as recording:
        for item in (view(0), view(3), view(4), metrics(2), view(0, "next-life"), metrics(3)):
            recording.add_live(item)
        assert recording.gaps == 2
        recording.finish()
    assert messages(tmp_path, "gap") == [
        RecordingGap("view/actor-0", "life", 1, 2),
        RecordingGap("metrics/owner/learner", "life", 0, 2),
    ]


@pytest.mark.parametrize("is_finished", [False, True])
def test_what_was_sent_while_no_recorder_lived_is_marked(tmp_path: Path, is_finished: bool) -> None:
    write(tmp_path, is_finished=is_finished)
    with record(tmp_path, "rec-2") as recording:
        recording.add_live(view(20))
        recording.finish()
    assert messages(tmp_path, "gap") == [RecordingGap("view/actor-0", "life", 12, 8)]


def test_snapshots_are_known_after_a_restart_and_lost_ones_marked(tmp_path: Path) -> None:
    with record(tmp_path) as recording:
        recording.add_snapshot(snapshot(4))
        recording.add_lost_snapshot(5)
        recording.flush()
    with record(tmp_path, "rec-2") as recording:
        assert recording.has_snapshot(4, snapshot(4).digest)
        assert not recording.has_snapshot(4, "00" * 32)
        assert not recording.has_snapshot(5, snapshot(5).digest)
        recording.finish()
    assert messages(tmp_path, "snapshot") == [snapshot(4)]
    assert messages(tmp_path, "gap") == [RecordingGap("policy/5", "rec-1", 5, 1)]


# Full disks ------------------------------------------------------------------------------------


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Lets no file of this process grow beyond a size, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_after_a_full_disk_the_next_one_goes_on_where_it_was_full(tmp_path: Path) -> None:
    def write_much(recording: Recording) -> None:
        for offset in range(100):
            recording.add_entry(entry(offset, 2000))
            recording.flush()

    with record(tmp_path) as recording, largest_file(50_000), pytest.raises(OSError, match="large"):
        write_much(recording)
    held = recording.held_offset
    assert 10 < held < 100
    with largest_file(20_000), pytest.raises(OSError, match="large"):
        record(tmp_path, "rec-2")
    assert not list(tmp_path.glob("*.partial"))
    with record(tmp_path, "rec-3") as again:
        assert again.next_offset == held
        for offset in range(held, 100):
            again.add_entry(entry(offset, 2000))
        again.finish()
    assert offsets(tmp_path) == list(range(100))


def test_a_message_of_a_recording_is_decoded_or_says_why_not() -> None:
    picture = RecordedMessage("view/a/image", "protobuf", 0, 0, 0, b"\x0a\x00")
    with pytest.raises(ValueError, match=r"expected .* as msgpack"):
        picture.decode()
