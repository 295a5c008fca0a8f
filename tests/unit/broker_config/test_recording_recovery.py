"""`recover` keeps what is whole of a broken file, says what is lost, and touches nothing else."""

from __future__ import annotations

import resource
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from broker_config.errors import StorageError
from broker_config.messages import JournalEntry, RecorderStarted, Snapshot
from broker_config.recording.check import RecordingCheck
from broker_config.recording.format import segment_path
from broker_config.recording.reader import read_excerpt
from broker_config.recording.recording import Recording, iter_recording
from broker_config.recording.recovery import Recovery, recover_segment
from deploy.presets import load_preset
from tests.synthetic_recording import RUN, Heard, SyntheticRun, record

PRESET = load_preset("imitation-smoke", ["schedule.iterations=1", "task.horizon=2"])


@pytest.fixture(autouse=True)
def no_fsync(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.fsync", lambda _: None)  # hundreds of them; nobody cuts the power


@pytest.fixture(scope="module")
def heard() -> list[Heard]:
    return list(SyntheticRun(PRESET, view_bytes=50, weights_bytes=50).messages())


def written(tmp_path: Path, heard: list[Heard]) -> bytes:
    record(tmp_path / "whole", heard, flush_every=6)
    return segment_path(tmp_path / "whole", 0).read_bytes()


def messages(path: Path) -> list[object]:
    return [item.decode() for item in iter_recording(path) if item.encoding == "msgpack"]


def faults(path: Path) -> list[str]:
    return [it.text for it in RecordingCheck(path).findings() if it.is_fault]


def recovered(broken: Path, content: bytes, output: Path) -> Recovery:
    """Recovers a file of this content, which must stay as it is."""
    broken.write_bytes(content)
    try:
        return recover_segment(broken, output)
    finally:
        assert broken.read_bytes() == content
        assert not list(broken.parent.glob("*.partial"))


def test_a_file_cut_off_anywhere_keeps_all_before_the_cut(
    tmp_path: Path, heard: list[Heard]
) -> None:
    file = written(tmp_path, heard)
    whole = messages(tmp_path / "whole")
    kept, refusals = set(), []
    for size in [*range(0, 200, 13), *range(200, len(file), len(file) // 60), len(file) - 1]:
        output = tmp_path / f"{size}.mcap"
        try:
            recovery = recovered(tmp_path / "cut", file[:size], output)
        except StorageError as error:
            refusals.append(str(error))
            assert not output.exists()
            continue
        assert messages(output) == whole[: len(messages(output))]
        assert [it.kind for it in recovery.damages] == ["cut off"]
        assert read_excerpt(output) is None, "a recorder may go on with it"
        kept.add(recovery.messages)
    assert len(kept) == 4, "each flush is a chunk"
    assert all("expected at least one whole message; got none" in it for it in refusals)
    assert max(kept) == sum(1 for _ in iter_recording(tmp_path / "whole"))


def test_a_recorder_goes_on_with_what_was_cut_off(tmp_path: Path, heard: list[Heard]) -> None:
    file = written(tmp_path, heard)
    folder = tmp_path / "again"
    folder.mkdir()
    recovered(tmp_path / "cut", file[: len(file) // 2], segment_path(folder, 0))
    with Recording(folder, RUN, "rec-2") as recording:
        entries = [it for it in heard if isinstance(it, JournalEntry)]
        snapshots = [it for it in heard if isinstance(it, Snapshot)]
        assert 0 < recording.next_offset < len(entries)
        for snapshot in snapshots:
            if not recording.has_snapshot(snapshot.version, snapshot.digest):
                recording.add_snapshot(snapshot)
        for entry in entries[recording.next_offset :]:
            recording.add_entry(entry)
        recording.finish()
    assert faults(folder) == []


def test_a_flipped_bit_costs_one_chunk_at_most(tmp_path: Path, heard: list[Heard]) -> None:
    file = written(tmp_path, heard)
    whole = messages(tmp_path / "whole")
    losses = set()
    for position in range(0, len(file), len(file) // 150):
        flipped = bytearray(file)
        flipped[position] ^= 1 << (position % 8)
        output = tmp_path / f"{position}.mcap"
        recovery = recovered(tmp_path / "flipped", bytes(flipped), output)
        assert recovery.damages, f"byte {position}"
        found = messages(output)
        lost = len(whole) - len(found)
        assert 0 <= lost <= 10, f"byte {position}"
        assert [it for it in whole if it in found] == found, f"byte {position}"
        assert bool(lost) <= bool(faults(output)), f"byte {position}"
        losses.add(lost > 0)
    assert losses == {False, True}


def test_a_lost_chunk_is_told_and_no_recorder_goes_on(tmp_path: Path, heard: list[Heard]) -> None:
    file = bytearray(written(tmp_path, heard))
    middle = len(file) // 2
    file[middle] ^= 1
    output = segment_path(tmp_path, 0)
    recovery = recovered(tmp_path / "flipped", bytes(file), output)
    (damage, checksum) = recovery.damages
    assert (damage.kind, checksum.kind) == ("lost", "changed")
    assert damage.at_byte < middle < damage.end_byte
    assert recovery.missing
    assert len(recovery.entries) == 2
    (_, before), (after, _) = recovery.entries
    excerpt = read_excerpt(output)
    assert excerpt is not None
    assert excerpt.part == f"without bytes {damage.at_byte} to {damage.end_byte}"
    missing = after - before - 1
    assert f"expected journal entry {before + 1}; got {after}: {missing} missing" in faults(output)
    with pytest.raises(StorageError, match="expected a segment that a recorder wrote; got a recov"):
        Recording(tmp_path, RUN, "rec-2")


def test_a_file_without_beginning_or_end_keeps_its_middle(
    tmp_path: Path, heard: list[Heard]
) -> None:
    file = written(tmp_path, heard)
    whole = messages(tmp_path / "whole")
    for name, content in {
        "zeroed head": b"\0" * 512 + file[512:],
        "no head": file[60:],
        "no head, no end": file[60:-300],
    }.items():
        output = tmp_path / f"{name}.mcap"
        recovery = recovered(tmp_path / "broken", content, output)
        found = messages(output)
        assert found
        assert [it for it in whole if it in found] == found
        assert not any(isinstance(it, RecorderStarted) for it in found), name
        assert recovery.damages[0].what == "another beginning"
        reader = make_reader(BytesIO(output.read_bytes()), validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages()) == recovery.messages


def test_nothing_is_recovered_from_what_is_foreign_or_empty(tmp_path: Path) -> None:
    foreign = BytesIO()
    writer = Writer(foreign)
    writer.start()
    channel = writer.register_channel("chatter", "json", 0)
    writer.add_message(channel, 1, b"{}", 1)
    writer.finish()
    output = tmp_path / "new.mcap"
    for content in (b"h" * 5000, foreign.getvalue(), b"\x05\x00\x00\x00zstd" * 50):
        with pytest.raises(StorageError, match="of a clothbus recording; got another file"):
            recovered(tmp_path / "foreign", content, output)
        assert not output.exists()
    with pytest.raises(StorageError, match="expected at least one whole message; got none"):
        recovered(tmp_path / "empty", b"", output)
    with pytest.raises(StorageError, match="expected a segment that can be read"):
        recover_segment(tmp_path / "nowhere.mcap", output)
    assert not output.exists()


def test_nothing_is_overwritten(tmp_path: Path, heard: list[Heard]) -> None:
    written(tmp_path, heard)
    source, output = segment_path(tmp_path / "whole", 0), tmp_path / "there.mcap"
    before = source.read_bytes()
    output.write_bytes(b"mine")
    with pytest.raises(StorageError, match="expected nothing there; got a file"):
        recover_segment(source, output)
    with pytest.raises(StorageError, match="expected nothing there; got a file"):
        recover_segment(source, source)
    assert (output.read_bytes(), source.read_bytes()) == (b"mine", before)
    recovery = recover_segment(source, tmp_path / "copy.mcap")
    assert recovery.damages == []
    assert messages(tmp_path / "copy.mcap") == messages(source)
    assert faults(tmp_path / "copy.mcap") == []


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Lets no file of this process grow beyond a size, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, heard: list[Heard]) -> None:
    written(tmp_path, heard)
    output = tmp_path / "new.mcap"
    with largest_file(1000), pytest.raises(StorageError, match="expected disks that can be read"):
        recover_segment(segment_path(tmp_path / "whole", 0), output)
    assert [it.name for it in tmp_path.iterdir()] == ["whole"]


def test_damaged_lengths_are_passed_over(tmp_path: Path, heard: list[Heard]) -> None:
    file = bytearray(written(tmp_path, heard))
    first_chunk = file.index(b"\x04\x00\x00\x00zstd") - 28 - 9
    file[first_chunk + 1 : first_chunk + 9] = struct.pack("<Q", 1 << 60)
    output = tmp_path / "new.mcap"
    recovery = recovered(tmp_path / "broken", bytes(file), output)
    assert recovery.damages[0].what == f"a record of kind 6 with {1 << 60} bytes"
    assert recovery.messages > 10
