"""Commands on a large recording: `info`, `check` and `slice`, their rates and their memory.

    python -m tests.benchmarks.recording_files --gb 10

A recording of a run that never was is written into a temporary folder, and deleted afterwards. Each
command is a process of its own; its memory is the most that it had resident, as the kernel says.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from broker_config.messages import JournalEntry
from deploy.presets import load_preset
from deploy.process import child_environment
from tests.benchmarks.measuring import RESULTS, keep_result
from tests.benchmarks.tables import recording_files
from tests.synthetic_recording import Heard, SyntheticRun, record

SETTINGS = ("schedule.iterations=1000000", "task.horizon=30")
WEIGHTS_BYTES = 400_000
VIEW_BYTES = 21_000
FLUSH_EVERY = 400
COMMANDS = {
    "info": ["info"],
    "check": ["check"],
    "slice of 100 episodes": ["slice", "--episodes", "300-399"],
    "slice of 10 seconds": ["slice", "--from-secs", "10", "--to-secs", "20"],
}


def written(size_bytes: int) -> Iterator[Heard]:
    """Whole iterations, until their payloads have this size."""
    run = SyntheticRun(load_preset("imitation-smoke", SETTINGS), WEIGHTS_BYTES, VIEW_BYTES)
    total_bytes = 0
    for message in run.messages():
        yield message
        match message:
            case JournalEntry():
                total_bytes += len(message.payload)
                if total_bytes > size_bytes and message.name.startswith("snapshot/"):
                    return
            case _:
                total_bytes += len(getattr(message, "picture", getattr(message, "weights", b"")))


def run(*arguments: object) -> dict[str, float]:
    """Runs a Python module; says how long it took and how much memory it had."""
    began_secs = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", *map(str, arguments)],
        env=child_environment(),
        stdout=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, f"{arguments}: exit code {process.returncode}"
    return {
        "secs": round(time.monotonic() - began_secs, 1),
        "cpu_secs": round(usage.ru_utime + usage.ru_stime, 1),
        "peak_mib": round(usage.ru_maxrss / 1024, 1),
    }


def measure(folder: Path, size_gb: float) -> dict[str, object]:
    """Writes a recording, and runs each command on it."""
    recording = folder / "recording"
    wrote = run("tests.benchmarks.recording_files", "--gb", size_gb, "--write", recording)
    commands = {}
    for number, (name, (command, *options)) in enumerate(COMMANDS.items()):
        output = ["--output", folder / f"slice-{number}"] if command == "slice" else []
        commands[name] = run("deploy.cli", command, recording, *output, *options)
        if output:
            size_bytes = sum(path.stat().st_size for path in output[1].iterdir())
            commands[name]["written_mb"] = round(size_bytes / 1e6, 1)
    paths = list(recording.iterdir())
    return {
        "size_gb": round(sum(path.stat().st_size for path in paths) / 1e9, 2),
        "segments": len(paths),
        "written": wrote,
        "commands": commands,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--gb", type=float, default=10.0)
    parser.add_argument("--folder", type=Path, help="for the recording; default: /tmp")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.write:
        record(arguments.write, written(int(arguments.gb * 1e9)), flush_every=FLUSH_EVERY)
        return
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        result = measure(Path(name), arguments.gb)
    keep_result(arguments.out, "recording_files", result)
    print(recording_files([json.loads(arguments.out.read_text().splitlines()[-1])]))


if __name__ == "__main__":
    main()
