"""What can be seen of a run from outside: its processes, journal, heartbeats and evaluation."""

from __future__ import annotations

import sqlite3
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from broker_config.bus import Bus
from broker_config.errors import StorageError
from broker_config.journal import JournalReader
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import Heartbeat
from tests.faults.cells import Role

_COMMANDS = {
    "router": Role.ROUTER,
    "learner": Role.LEARNER,
    "actor": Role.ACTOR,
    "record": Role.RECORDER,
    "evaluator": Role.EVALUATOR,
    "discriminator": Role.DISCRIMINATOR,
}
_BATCH_BYTES = 8 << 20


@dataclass(frozen=True)
class Child:
    """A process that the supervisor of a run has started."""

    role: Role
    id: str
    pid: int


def children(supervisor_pid: int) -> dict[str, Child]:
    """The processes of a run that live now, by id."""
    listed = Path(f"/proc/{supervisor_pid}/task/{supervisor_pid}/children").read_text().split()
    found = (_child(int(pid)) for pid in listed)
    return {child.id: child for child in found if child is not None}


def _child(pid: int) -> Child | None:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
        command = words[words.index("deploy.cli") + 1]
    except (OSError, ValueError, IndexError):
        return None  # it has just died, or has not become a clothbus process yet
    if command not in _COMMANDS:
        return None  # a fork of the supervisor, just before it becomes another
    role = _COMMANDS[command]
    named = words[words.index("--id") + 1] if "--id" in words else role.value
    return Child(role, named, pid)


@dataclass(frozen=True)
class Entry:
    """A journal entry without its payload."""

    offset: int
    name: str
    unix_secs: float


class JournalTail:
    """The names of a journal's entries, read as they come."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._reader: JournalReader | None = None
        self.entries: list[Entry] = []

    def poll(self) -> None:
        if self._reader is None:
            try:
                self._reader = JournalReader(self._path)
            except StorageError:
                return  # the learner has not made it yet
        while batch := self._reader.read(len(self.entries), _BATCH_BYTES):
            self.entries += [Entry(it.offset, it.name, it.unix_secs) for it in batch]

    def close(self) -> None:
        if self._reader is not None:
            self._reader.close()

    @property
    def trajectories(self) -> int:
        return sum(entry.name.startswith("trajectory/") for entry in self.entries)

    def first(
        self, prefixes: tuple[str, ...], since_secs: float, not_of: str | None = None
    ) -> Entry | None:
        """The first entry of such a name committed since then, and not of an incarnation."""
        return next(
            (
                entry
                for entry in self.entries
                if entry.unix_secs >= since_secs
                and entry.name.startswith(prefixes)
                and (not_of is None or f"/{not_of}/" not in entry.name)
            ),
            None,
        )


@dataclass(frozen=True)
class Heard:
    heartbeat: Heartbeat
    unix_secs: float


class Heartbeats:
    """The newest heartbeat of each process."""

    def __init__(self, bus: Bus) -> None:
        self._newest: dict[int, Heard] = {}
        self._lock = threading.Lock()
        bus.subscribe(bus.keys.every(Kind.LIVE), Heartbeat, self._take)

    def _take(self, _: ParsedKey, heartbeat: Heartbeat) -> None:
        with self._lock:
            self._newest[heartbeat.pid] = Heard(heartbeat, time.time())

    def of(self, pid: int) -> Heard | None:
        with self._lock:
            return self._newest.get(pid)


def spooled(spool: Path) -> list[str]:
    """The trajectories that wait in an actor's spool, as `<actor>/<incarnation>/<sequence>`."""
    connection = sqlite3.connect(f"file:{spool}?mode=ro", uri=True)
    try:
        rows = connection.execute(
            "SELECT actor, incarnation, sequence FROM outbox, spool ORDER BY sequence"
        )
        return [f"{actor}/{incarnation}/{sequence}" for actor, incarnation, sequence in rows]
    finally:
        connection.close()


def whole_lines(path: Path) -> list[str]:
    """The lines of a file that may not be there yet, without a last one that is torn."""
    return path.read_text().split("\n")[:-1] if path.exists() else []


def has_ended(pid: int) -> bool:
    """Whether a process is gone, or is only waited for by its parent."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True
