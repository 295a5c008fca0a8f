"""`check` finds what is missing or damaged, wherever it is, and nothing in what is whole."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from broker_config.codec import SCHEMA_VERSION, decode, encode
from broker_config.errors import StorageError
from broker_config.journal import JournalReader
from broker_config.messages import (
    IterationEnded,
    JournalEntry,
    RecorderStarted,
    Rewards,
    Snapshot,
    Trajectory,
    View,
    weights_digest,
)
from broker_config.recording.check import RecordingCheck
from broker_config.recording.format import Facts, segment_path
from broker_config.recording.recording import Recording
from broker_config.recording.segment import SegmentWriter, to_ns
from broker_config.recording.viewers import shown_of_view
from deploy.presets import load_preset
from tests.synthetic_recording import RUN, Heard, SyntheticRun, journal, record

PRESET = load_preset("imitation-smoke", ["schedule.iterations=2", "task.horizon=2"])


@pytest.fixture(scope="module")
def heard() -> list[Heard]:
    return list(SyntheticRun(PRESET).messages())


def faults(path: Path, journal_path: Path | None = None) -> list[str]:
    live = None if journal_path is None else JournalReader(journal_path)
    found = [it for it in RecordingCheck(path, live).findings() if it.is_fault]
    if live is not None:
        live.close()
    return [f"{it.where}: {it.text}" for it in found]


def notes(path: Path) -> list[str]:
    return [it.text for it in RecordingCheck(path).findings() if not it.is_fault]


def replaced(
    heard: Iterable[Heard], name: str, change: Callable[[JournalEntry], Heard]
) -> list[Heard]:
    """The messages with the one entry changed whose name begins so."""
    made, count = [], 0
    for message in heard:
        if isinstance(message, JournalEntry) and message.name.startswith(name):
            made.append(change(message))
            count += 1
        else:
            made.append(message)
    assert count == 1
    return made


def with_payload(entry: JournalEntry, message: object) -> JournalEntry:
    return dataclasses.replace(entry, payload=encode(message))


# Whole ------------------------------------------------------------------------------------------


def test_a_whole_recording_has_no_fault_and_says_how_much_was_read(
    tmp_path: Path, heard: list[Heard]
) -> None:
    record(tmp_path / "rec", heard, segment_bytes=100_000)
    journal(tmp_path / "journal.sqlite", heard)
    assert len(list((tmp_path / "rec").glob("*.mcap"))) > 2
    assert faults(tmp_path / "rec", tmp_path / "journal.sqlite") == []
    check = RecordingCheck(tmp_path / "rec")
    assert [it.text for it in check.findings()] == [
        "recorder rec-1 (clothbus 0.1.0) began with journal entry 0"
    ]
    episodes = PRESET.schedule.episodes
    counted = check.checked
    assert (counted.trajectories, counted.snapshots, counted.rewards) == (episodes, 3, 2)
    assert counted.entries == sum(isinstance(it, JournalEntry) for it in heard)


def test_each_segment_is_whole_by_itself(tmp_path: Path, heard: list[Heard]) -> None:
    record(tmp_path, heard, segment_bytes=100_000)
    for path in sorted(tmp_path.glob("*.mcap")):
        assert faults(path) == []


def test_a_recorder_killed_twice_leaves_a_recording_without_a_fault(
    tmp_path: Path, heard: list[Heard]
) -> None:
    third = len(heard) // 3
    for number in range(3):
        part = heard[number * third : (number + 1) * third if number < 2 else None]
        record(tmp_path / "rec", part, is_finished=number == 2, incarnation=f"rec-{number}")
    journal(tmp_path / "journal.sqlite", heard)
    assert faults(tmp_path / "rec", tmp_path / "journal.sqlite") == []
    assert sum("began with journal entry" in it for it in notes(tmp_path / "rec")) == 3


# Missing or wrong -------------------------------------------------------------------------------


def test_what_the_journal_has_and_the_recording_has_not(tmp_path: Path, heard: list[Heard]) -> None:
    journal(tmp_path / "journal.sqlite", heard)
    record(tmp_path / "short", heard[:-7])
    (fault,) = faults(tmp_path / "short", tmp_path / "journal.sqlite")
    entries = sum(isinstance(it, JournalEntry) for it in heard)
    assert f"expected all journal entries before {entries}, as the journal has" in fault

    def retell(entry: JournalEntry) -> JournalEntry:
        ended = decode(entry.payload, Rewards)
        return with_payload(entry, dataclasses.replace(ended, numbers={"loss": 0.25}))

    record(tmp_path / "other", replaced(heard, "rewards/1", retell))
    (fault,) = faults(tmp_path / "other", tmp_path / "journal.sqlite")
    assert "rewards/1: expected a payload of digest" in fault


def test_what_another_segment_may_hold_is_no_fault_of_one_by_itself(
    tmp_path: Path, heard: list[Heard]
) -> None:
    journal(tmp_path / "journal.sqlite", heard)
    record(tmp_path / "rec", heard, segment_bytes=100_000)
    for path in sorted((tmp_path / "rec").glob("*.mcap")):
        assert faults(path, tmp_path / "journal.sqlite") == []


def test_a_recorder_may_be_stopped_before_a_verdict(tmp_path: Path, heard: list[Heard]) -> None:
    names = [getattr(it, "name", "") for it in heard]
    record(tmp_path, heard[: names.index("trajectory/actor-0/life/4") + 1])
    assert faults(tmp_path) == []
    assert any("actor-0/life/4: expected its verdict behind it" in it for it in notes(tmp_path))


def test_weights_that_are_missing_or_others_or_noted_as_gone(
    tmp_path: Path, heard: list[Heard]
) -> None:
    without = [it for it in heard if not (isinstance(it, Snapshot) and it.version == 1)]
    record(tmp_path / "without", without)
    (fault,) = faults(tmp_path / "without")
    assert "policy version 1: expected weights of digest" in fault
    assert fault.endswith("got none")

    def other(message: Heard) -> Heard:
        if not (isinstance(message, Snapshot) and message.version == 1):
            return message
        return dataclasses.replace(message, weights=b"others", digest=weights_digest(b"others"))

    record(tmp_path / "other", [other(it) for it in heard])
    (fault,) = faults(tmp_path / "other")
    assert fault.endswith(f"got {weights_digest(b'others')[:16]}")

    folder = tmp_path / "gone"
    folder.mkdir()
    with Recording(folder, RUN, "rec-1") as recording:
        for message in heard:
            match message:
                case Snapshot(version=1):
                    recording.add_lost_snapshot(1)
                case Snapshot():
                    recording.add_snapshot(message)
                case JournalEntry():
                    recording.add_entry(message)
                case _:
                    recording.add_live(message)
        recording.finish()
    assert faults(folder) == []
    assert any("the recorder notes that they were gone" in it for it in notes(folder))


def test_rewards_that_were_not_announced_or_too_few(tmp_path: Path, heard: list[Heard]) -> None:
    def of_others(entry: JournalEntry) -> JournalEntry:
        rewards = decode(entry.payload, Rewards)
        return with_payload(
            entry,
            dataclasses.replace(rewards, digest="cd" * 32, rewards=np.zeros(1, np.float32)),
        )

    record(tmp_path / "others", replaced(heard, "rewards/1", of_others))
    assert [it.split(": ", 1)[1] for it in faults(tmp_path / "others")] == [
        f"rewards of iteration 1: expected those of D_G {_announced(heard)}; got {'cd' * 8}",
        "rewards of iteration 1: expected 6; got 1",
    ]

    def nothing(entry: JournalEntry) -> JournalEntry:
        later = IterationEnded(7, "ab" * 32, 0.0, 0.0)
        return dataclasses.replace(with_payload(entry, later), name="later/7")

    record(tmp_path / "without", replaced(heard, "rewards/0", nothing))
    (fault,) = faults(tmp_path / "without")
    assert "iteration 0: expected rewards once announced; none" in fault
    record(tmp_path / "late", replaced(heard, "announced/1", nothing))
    (fault,) = faults(tmp_path / "late")
    assert "rewards of iteration 1: expected them to be announced before" in fault

    def misnamed(entry: JournalEntry) -> JournalEntry:
        return dataclasses.replace(entry, name="control/1/0")

    record(tmp_path / "misnamed", replaced(heard, "iteration/0", misnamed))
    (fault,) = faults(tmp_path / "misnamed")
    assert "control/1/0: expected Control; got IterationEnded" in fault


def _announced(heard: list[Heard]) -> str:
    (rewards,) = (
        decode(it.payload, Rewards)
        for it in heard
        if isinstance(it, JournalEntry) and it.name == "rewards/1"
    )
    return rewards.digest[:16]


def test_trajectories_that_do_not_fit_or_have_no_verdict(
    tmp_path: Path, heard: list[Heard]
) -> None:
    def small(entry: JournalEntry) -> JournalEntry:
        trajectory = decode(entry.payload, Trajectory)
        observations = np.zeros((trajectory.steps + 1, 4, 4, 3), np.uint8)
        return with_payload(entry, dataclasses.replace(trajectory, observations=observations))

    record(tmp_path / "small", replaced(heard, "trajectory/actor-0/life/4", small))
    (fault,) = faults(tmp_path / "small")
    assert "expected uint8 [T+1, 84, 84, 3]; got uint8 [3, 4, 4, 3] from actor-0" in fault

    def nothing(entry: JournalEntry) -> JournalEntry:
        return dataclasses.replace(entry, name=f"later/{entry.offset}")

    record(tmp_path / "unjudged", replaced(heard, "trajectory/actor-0/life/4", nothing))
    (fault,) = faults(tmp_path / "unjudged")
    assert "verdict on trajectory actor-0/life/4: expected it before" in fault


def test_views_that_are_missing_without_a_note_and_pictures_of_others(tmp_path: Path) -> None:
    def view(sequence: int) -> View:
        return View("a", "life", sequence, 0, 0, 0, 0, None, None, b"picture", "png", 1.0)

    other = dataclasses.replace(view(9), picture=b"another")
    segment = SegmentWriter(segment_path(tmp_path, 0))
    started = RecorderStarted(RUN, "rec-1", "0.1.0", 0)
    segment.add("recorder", "RecorderStarted", encode(started))
    facts = Facts()
    for message in (started, view(0), view(3)):
        facts.note(message)
    for sequence in (0, 3):
        segment.add("view/a", "View", encode(view(sequence)), sequence)
        seen = other if sequence == 3 else view(0)
        for shown in shown_of_view(seen, to_ns(seen.unix_secs)):
            segment.add_shown(shown, seen.sequence)
    segment.finish(facts)
    segment.close()
    found = faults(tmp_path)
    assert len(found) == 3
    assert "view/a of life: expected message 1, or a gap to be noted; got 3" in found[0]
    for number, what in enumerate(("image", "annotations"), start=1):
        words = f"view/a/{what}: expected what viewers see of message 3; got something else, of 9"
        assert words in found[number]


def test_entries_missing_double_or_misplaced(tmp_path: Path, heard: list[Heard]) -> None:
    entries = [it for it in heard if isinstance(it, JournalEntry)][:4]
    segment = SegmentWriter(segment_path(tmp_path, 0))
    started = RecorderStarted(RUN, "rec-1", "0.1.0", 0)
    segment.add("recorder", "RecorderStarted", encode(started))
    facts = Facts()
    facts.note(started)
    for entry in (entries[0], entries[3], entries[0]):
        facts.note(entry)
        segment.add("journal/run", "JournalEntry", encode(entry), entry.offset)
    segment.add("snapshot", "JournalEntry", b"no message")
    segment.finish(facts)
    segment.close()
    found = faults(tmp_path)
    assert any("expected journal entry 1; got 3: 2 missing" in it for it in found)
    assert any("expected journal entry 4; got 0 once more" in it for it in found)
    assert any("expected topic journal/trajectory for a JournalEntry" in it for it in found)
    assert any("snapshot: payload: expected" in it for it in found)


def test_missing_and_misplaced_segments(tmp_path: Path, heard: list[Heard]) -> None:
    record(tmp_path, heard, segment_bytes=100_000)
    paths = sorted(tmp_path.glob("*.mcap"))
    kept = paths[1].rename(tmp_path / "kept")
    found = faults(tmp_path)
    assert found[0] == f": expected segment 000001.mcap in {tmp_path}; it is not there"
    assert "expected a segment that goes on with journal entry" in found[1]
    kept.rename(paths[1])
    paths[0].unlink()
    assert f"expected segment 000000.mcap in {tmp_path}" in faults(tmp_path)[0]


# Damaged files ----------------------------------------------------------------------------------


def test_a_bit_flipped_anywhere_is_found(tmp_path: Path) -> None:
    preset = load_preset("reaching-smoke")
    small = [it for it in SyntheticRun(preset, 50, 20).messages() if not _is_trajectory(it)][:9]
    record(tmp_path / "whole", small, flush_every=4)
    assert faults(tmp_path / "whole") == []
    file = segment_path(tmp_path / "whole", 0).read_bytes()
    flipped_file = tmp_path / "000000.mcap"
    for position in range(0, len(file), 7):
        flipped = bytearray(file)
        flipped[position] ^= 1 << (position % 8)
        flipped_file.write_bytes(flipped)
        assert faults(flipped_file), f"byte {position} of {len(file)}"
        assert flipped_file.read_bytes() == flipped


def test_a_file_cut_off_anywhere_is_found(tmp_path: Path) -> None:
    preset = load_preset("reaching-smoke")
    small = [it for it in SyntheticRun(preset, 50, 20).messages() if not _is_trajectory(it)][:9]
    record(tmp_path / "whole", small, flush_every=4)
    file = segment_path(tmp_path / "whole", 0).read_bytes()
    cut_file = tmp_path / "000000.mcap"
    for size in range(0, len(file), 11):
        cut_file.write_bytes(file[:size])
        assert any("expected a finished segment" in it for it in faults(cut_file)), size


def _is_trajectory(message: Heard) -> bool:
    return isinstance(message, JournalEntry) and message.name.startswith(("trajectory", "ended"))


def test_damage_in_the_middle_hides_nothing_behind_it(tmp_path: Path, heard: list[Heard]) -> None:
    record(tmp_path, heard)
    path = segment_path(tmp_path, 0)
    file = bytearray(path.read_bytes())
    file[len(file) // 2] ^= 1
    path.write_bytes(file)
    found = faults(tmp_path)
    assert "that cannot be read" in found[0]
    check = RecordingCheck(tmp_path)
    list(check.findings())
    entries = sum(isinstance(it, JournalEntry) for it in heard)
    assert entries / 2 < check.checked.entries < entries


def test_foreign_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "000000.mcap"
    for content in (b"hello" * 100, b"\x89PNG\r\n", b"\0" * 5000):
        path.write_bytes(content)
        (fault,) = faults(tmp_path)
        assert "expected a segment of a clothbus recording; got another file" in fault
        assert path.read_bytes() == content
    path.unlink()
    with pytest.raises(StorageError, match=r"expected segments like 000000\.mcap; got none"):
        faults(tmp_path)


def test_another_schema_version_is_refused_with_both_versions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, heard: list[Heard]
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("broker_config.recording.segment.SCHEMA_VERSION", SCHEMA_VERSION + 1)
        record(tmp_path / "newer", heard[:3])
    rule = rf"expected schema version {SCHEMA_VERSION}, .*; got {SCHEMA_VERSION + 1}; use"
    with pytest.raises(StorageError, match=rule):
        faults(tmp_path / "newer")
    torn = segment_path(tmp_path / "newer", 0)
    torn.write_bytes(torn.read_bytes()[:-20])
    with pytest.raises(StorageError, match=rule):
        faults(tmp_path / "newer")


def test_gaps_are_counted(tmp_path: Path) -> None:
    views = [it for it in SyntheticRun(PRESET).messages() if isinstance(it, View)]
    record(tmp_path, [views[0], views[3], views[4], views[7]])
    assert faults(tmp_path) == []
    assert "4 messages of view/actor-0 were dropped, as noted" in notes(tmp_path)
