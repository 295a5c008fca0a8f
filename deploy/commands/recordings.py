"""The commands for recordings: `info`, `check`, `recover`, `slice`."""

from __future__ import annotations

import re
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from broker_config.errors import PresetError, StorageError
from deploy.byte_progress import byte_progress
from deploy.process import FAILED_CHECK_EXIT
from deploy.run_folder import RunFolder

MOST_FAULTS = 100
"""So many are printed; the rest is counted."""

_RANGE = re.compile(r"(\d+)(?:-(\d+))?")


def info(path: Annotated[Path, tyro.conf.Positional], /, json: bool = False) -> None:
    """Say what is in a recording: from its indexes, without reading it all.

    Args:
        path: A recording's folder, a run folder, or a .mcap file.
        json: Print JSON, for programs.
    """
    from broker_config.recording.info import read_info
    from deploy.recorder.tables import info_json, info_tables

    recording = _recording(path)
    with byte_progress("looking", _size_bytes(recording)) as on_bytes:
        found = read_info(recording, on_bytes)
    console = Console()
    if json:
        console.print_json(data=info_json(found))
        return
    for part in info_tables(found):
        console.print(part, highlight=False, soft_wrap=True)


def check(path: Annotated[Path, tyro.conf.Positional], /, against: Path | None = None) -> None:
    """Read a recording wholly, and say whether it is whole: each fault is a line; exit code 1.

    Args:
        path: A recording's folder, a run folder, or a .mcap file.
        against: A run folder: compare each journal entry with its journal.
    """
    from broker_config.journal import JournalReader
    from broker_config.recording.check import RecordingCheck

    recording, console, faults = _recording(path), Console(), 0
    with ExitStack() as stack:
        journal = None
        if against is not None:
            journal = stack.enter_context(JournalReader(RunFolder(against).journal))
        on_bytes = stack.enter_context(byte_progress("checking", _size_bytes(recording)))
        reading = RecordingCheck(recording, journal, on_bytes)
        for finding in reading.findings():
            faults += finding.is_fault
            if not finding.is_fault or faults <= MOST_FAULTS:
                words = [] if finding.is_fault else ["note"]
                words += [finding.where] if finding.where else []
                line = ": ".join([*words, finding.text])
                console.print(line, highlight=False, soft_wrap=True, markup=False)
    if faults > MOST_FAULTS:
        console.print(f"and {faults - MOST_FAULTS} more", highlight=False)
    checked = reading.checked
    console.print(
        f"{recording}: {'whole' if not faults else f'not whole, {faults} faults'}; "
        f"{checked.size_bytes / 1e6:.1f} MB, {checked.messages} messages, {checked.entries} "
        f"journal entries, {checked.trajectories} trajectories, {checked.snapshots} policy "
        f"versions, {checked.rewards} rewards",
        highlight=False,
        soft_wrap=True,
        markup=False,
    )
    if faults:
        sys.exit(FAILED_CHECK_EXIT)


def recover(file: Annotated[Path, tyro.conf.Positional], /, output: Path) -> None:
    """Copy what is whole of a truncated or damaged file into a new one; the old is not touched.

    Args:
        file: A .mcap file of a recording.
        output: The new file; it must not be there yet.
    """
    from broker_config.recording.recovery import recover_segment
    from deploy.recorder.tables import recovery_lines

    if not file.is_file():
        raise StorageError(
            f"{file}: expected a .mcap file; got {'a folder' if file.is_dir() else 'nothing'}; "
            "name one file of a recording"
        )
    with byte_progress("recovering", file.stat().st_size) as on_bytes:
        recovery = recover_segment(file, output, on_bytes)
    for line in recovery_lines(file, output, recovery):
        Console().print(line, highlight=False, soft_wrap=True, markup=False)


def slice_recording(
    path: Annotated[Path, tyro.conf.Positional],
    /,
    output: Path,
    from_secs: float | None = None,
    to_secs: float | None = None,
    episodes: str | None = None,
    iterations: str | None = None,
    topics: tuple[str, ...] = (),
) -> None:
    """Cut a part out of a recording, into a recording that can be read by itself.

    With an episode come its ticket, every attempt at it, the policy that acted, its views, and what
    was measured meanwhile; with an iteration its episodes, announced samples and rewards. The
    beginning of the run with its preset is always there.

    Args:
        path: A recording's folder, a run folder, or a .mcap file.
        output: The new folder; it must not be there yet.
        from_secs: From when on, in seconds since the recording's first message.
        to_secs: Until when; the end if not given.
        episodes: Which, counted from 0: 5 or 3-7.
        iterations: Which, counted from 0: 2 or 2-3.
        topics: Only these; one that ends with / stands for all that begin so.
    """
    from broker_config.recording.slice import slice_recording as cut
    from broker_config.recording.slice_plan import Selection

    selection = Selection(
        _seconds(from_secs, to_secs),
        _range("episodes", episodes),
        _range("iterations", iterations),
        topics or None,
    )
    ways = (selection.secs, selection.episodes, selection.iterations)
    if sum(way is not None for way in ways) > 1 or selection == Selection():
        raise PresetError(
            "slice: expected one of --from-secs and --to-secs, --episodes, --iterations, or "
            f"--topics; got {selection.words}; say which part you want"
        )
    recording = _recording(path)
    with byte_progress("cutting", 2 * _size_bytes(recording)) as on_bytes:
        sliced = cut(recording, output, selection, on_bytes)
    Console().print(
        f"{output}: {selection.words}: {sliced.messages} messages, {sliced.entries} journal "
        f"entries, {sliced.trajectories} trajectories",
        highlight=False,
        soft_wrap=True,
        markup=False,
    )


def _recording(path: Path) -> Path:
    """The recording that a person names: of a run folder, what its recorder wrote."""
    if not path.exists():
        raise StorageError(
            f"{path}: expected a recording's folder, a run folder or a .mcap file; got nothing; "
            "check the path"
        )
    recording = RunFolder(path).recording
    return recording if recording.is_dir() else path


def _size_bytes(recording: Path) -> int:
    files = recording.glob("*.mcap") if recording.is_dir() else [recording]
    return sum(file.stat().st_size for file in files)


def _seconds(from_secs: float | None, to_secs: float | None) -> tuple[float, float] | None:
    if from_secs is None and to_secs is None:
        return None
    begin = 0.0 if from_secs is None else from_secs
    end = float("inf") if to_secs is None else to_secs
    if not 0 <= begin < end:
        raise PresetError(
            f"slice: expected 0 <= --from-secs < --to-secs; got {begin:g} and {end:g}"
        )
    return begin, end


def _range(option: str, text: str | None) -> range | None:
    if text is None:
        return None
    found = _RANGE.fullmatch(text)
    if found is None or int(found[2] or found[1]) < int(found[1]):
        raise PresetError(f"--{option}: expected a number or a range like 3-7; got {text}")
    return range(int(found[1]), int(found[2] or found[1]) + 1)
