"""What the benchmarks share: real processes, their memory, and results that are kept."""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from deploy.process import child_environment

RESULTS = Path("build/bench/results.jsonl")
START_SECS = 60.0
STOP_SECS = 60.0


class Started:
    """A Python module or file in a process of its own; its output goes to a file."""

    def __init__(self, log: Path, *arguments: object, python: str = sys.executable) -> None:
        self.log = log
        self._command = [python, *map(str, arguments)]
        self._environment = dict(child_environment())  # clothbus's processes end with this one
        self.start()

    def start(self) -> None:
        """Starts it, at first or again."""
        with self.log.open("ab") as output:
            self.process = subprocess.Popen(
                self._command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=self._environment,
            )

    @property
    def pid(self) -> int:
        return self.process.pid

    def send(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def kill(self) -> None:
        """As a crash would."""
        self.process.kill()
        self.process.wait()

    def wait(self, timeout_secs: float) -> None:
        """Waits for its end, which must be a success."""
        code = self.process.wait(timeout_secs)
        assert code == 0, f"exit code {code}: {self.said()}"

    def said(self) -> str:
        """The end of its output."""
        return self.log.read_text(errors="replace")[-3000:]

    def close(self) -> None:
        """Ends it in order, or by force."""
        if self.process.poll() is None:
            self.send(signal.SIGTERM)
            self.send(signal.SIGCONT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(STOP_SECS)
        if self.process.poll() is None:
            self.kill()


class Processes:
    """The processes of a benchmark, ended with it, the newest first."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def start(self, name: str, *arguments: object, python: str = sys.executable) -> Started:
        """Starts `python ARGUMENTS`."""
        started = Started(self._folder / f"{name}.log", *arguments, python=python)
        self._stack.callback(started.close)
        return started

    def clothbus(self, name: str, *arguments: object) -> Started:
        """Starts a clothbus command."""
        return self.start(name, "-m", "deploy.cli", *arguments)

    def router(self) -> tuple[Started, str]:
        """Starts a router; returns it and its address."""
        file = self._folder / "router.address"
        started = self.clothbus("router", "router", "--address-file", file)
        return started, wait_for_text(file, started)


def wait_for_text(path: Path, writer: Started) -> str:
    """Waits until a process has written a file."""
    deadline_secs = time.monotonic() + START_SECS
    while not (path.is_file() and path.read_text().strip()):
        assert writer.process.poll() is None, writer.said()
        assert time.monotonic() < deadline_secs, f"waited {START_SECS} s for {path}"
        time.sleep(0.02)
    return path.read_text().strip()


def wait_for_file(path: Path) -> None:
    """Waits for a sign; whoever started this process ends it if there is none."""
    while not path.exists():
        time.sleep(0.01)


def wait_for_sign(path: Path, processes: list[Started]) -> None:
    """Waits until one of the processes has made a file."""
    deadline_secs = time.monotonic() + START_SECS
    while not path.exists():
        for started in processes:
            assert started.process.poll() is None, started.said()
        assert time.monotonic() < deadline_secs, f"waited for {path}"
        time.sleep(0.02)


class MemorySampler:
    """Notes the resident memory of processes each second, in a file and in mind."""

    def __init__(self, path: Path, processes: dict[str, Started]) -> None:
        self._path = path
        self._processes = processes
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="memory", daemon=True)
        self.mib: dict[str, list[float]] = {name: [] for name in processes}

    def __enter__(self) -> MemorySampler:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        began_secs = time.monotonic()
        with self._path.open("w") as file:
            while not self._stop.wait(1.0):
                for name, started in self._processes.items():
                    self.mib[name].append(resident_mib(started.pid))
                sample = {name: values[-1] for name, values in self.mib.items()}
                line = {"secs": round(time.monotonic() - began_secs, 1), "mib": sample}
                file.write(json.dumps(line) + "\n")
                file.flush()


def resident_mib(pid: int) -> float:
    """Memory of a process that is its own, not of files that it maps."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return round(int(line.split()[1]) / 1024, 1)
    return 0.0  # it has ended


def percentile(values: Sequence[float], share: float) -> float:
    """The value that a share of all does not exceed (nearest rank)."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def keep_result(out: Path, benchmark: str, result: dict[str, Any]) -> None:
    """Prints a result, and appends it to a file as one line of JSON."""
    line = {
        "benchmark": benchmark,
        "at": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, {platform.system()}",
        "load_15_min": round(os.getloadavg()[2], 2),
        **result,
    }
    print(json.dumps(line, indent=2))
    out.parent.mkdir(parents=True, exist_ok=True)
    with out.open("a") as file:
        file.write(json.dumps(line) + "\n")


@contextlib.contextmanager
def cpu_secs_of(processes: dict[str, Started]) -> Iterator[dict[str, float]]:
    """Gives, once it is over, the processor time that each process has used meanwhile."""
    before = {name: _cpu_secs(it.pid) for name, it in processes.items()}
    used: dict[str, float] = {}
    yield used
    used.update({name: _cpu_secs(it.pid) - before[name] for name, it in processes.items()})


def _cpu_secs(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
