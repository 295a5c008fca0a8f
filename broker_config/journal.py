"""The journal: the append-only record of a run, from which everything else can be repeated.

One process appends (it holds the run's lock); any number of threads and processes read, also while
it appends. An append is acknowledged through a future that resolves once the entries are on the
disk. The writer thread takes whatever has queued up while the last commit was under way and commits
it together, so that a lone append waits for nothing and a burst shares its fsyncs.
"""

from __future__ import annotations

import queue
import sqlite3
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

from broker_config.closing import Closing
from broker_config.database import (
    Schema,
    open_database,
    open_read_only,
    storage_errors,
    transaction,
)
from broker_config.errors import StorageError
from broker_config.messages import JournalEntry

JOURNAL_FILE = "journal.sqlite"

_SCHEMA = Schema(
    subject="journal",
    application_id=0x636C6F6A,  # "cloj"
    version=2,
    statements=(
        "CREATE TABLE entries (offset INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE,"
        " payload BLOB NOT NULL, unix_secs REAL NOT NULL)",
    ),
)
_SELECT = "SELECT offset, name, payload, unix_secs FROM entries"
_GROUP_ENTRIES, _GROUP_BYTES = 1000, 32 << 20
"""A commit takes no more than this, so that the first of a burst does not wait for the last."""
_ITERATION_BYTES = 4 << 20
_PENDING_BYTES = 128 << 20
"""With more than this queued, `wait_for_room` waits for the disk."""


@dataclass(frozen=True)
class Appended:
    """Where an entry is."""

    offset: int
    is_new: bool
    """False when an entry of this name was there already; nothing was added then."""


@dataclass(frozen=True)
class _Append:
    entries: tuple[tuple[str, bytes], ...]
    size: int
    future: Future[tuple[Appended, ...]]


class JournalReader(Closing):
    """Reads a journal; a follower's or an offline tool's view of another process's file.

    Every thread that reads gets a connection of its own, so that readers wait for nobody.
    """

    def __init__(self, path: Path) -> None:
        """Opens the file.

        Raises:
            StorageError: It is missing, damaged, no journal, or of another schema version.
        """
        self._path = path
        self._local = threading.local()
        self._readers: list[sqlite3.Connection] = []
        self._readers_lock = threading.Lock()
        self._is_closed = False
        self._reader()

    def read(self, offset: int, max_bytes: int) -> tuple[JournalEntry, ...]:
        """Consecutive entries from `offset` on.

        The batch ends before its payloads are larger than `max_bytes`, but holds one entry if there
        is any.

        Raises:
            StorageError: The file cannot be read, or the journal is closed.
        """
        batch: list[JournalEntry] = []
        room = max_bytes
        with storage_errors(_SCHEMA.subject, self._path):
            cursor = self._reader().execute(
                f"{_SELECT} WHERE offset >= ? ORDER BY offset", [offset]
            )
            for row in cursor:
                room -= len(row[2])
                if room < 0 and batch:
                    break
                batch.append(JournalEntry(*row))
            cursor.close()
        return tuple(batch)

    def find(self, name: str) -> JournalEntry | None:
        """The entry of a name, if there is one.

        Raises:
            StorageError: The file cannot be read, or the journal is closed.
        """
        with storage_errors(_SCHEMA.subject, self._path):
            row = self._reader().execute(f"{_SELECT} WHERE name = ?", [name]).fetchone()
        return None if row is None else JournalEntry(*row)

    def entries(self, prefix: str = "", without: Sequence[str] = ()) -> list[JournalEntry]:
        """The entries whose names begin with a prefix, in order, all in memory.

        Args:
            prefix: What names must begin with.
            without: What they must not begin with; entries passed over are not read.

        Raises:
            StorageError: The file cannot be read, or the journal is closed.
        """
        rule, values = "substr(name, 1, ?) = ?", [len(prefix), prefix]
        for other in without:
            rule += " AND substr(name, 1, ?) <> ?"
            values += [len(other), other]
        with storage_errors(_SCHEMA.subject, self._path):
            rows = self._reader().execute(f"{_SELECT} WHERE {rule} ORDER BY offset", values)
            return [JournalEntry(*row) for row in rows]

    @property
    def end_offset(self) -> int:
        """One past the newest entry; 0 for an empty journal."""
        with storage_errors(_SCHEMA.subject, self._path):
            query = "SELECT ifnull(max(offset) + 1, 0) FROM entries"
            return int(self._reader().execute(query).fetchone()[0])

    def __iter__(self) -> Iterator[JournalEntry]:
        """All entries that there were when the iteration began, a few in memory at a time."""
        offset, end = 0, self.end_offset
        while offset < end:
            for entry in self.read(offset, _ITERATION_BYTES):
                if entry.offset < end:
                    yield entry
                offset = entry.offset + 1

    def close(self) -> None:
        """Closes the file; a second call does nothing."""
        with self._readers_lock:
            self._is_closed = True
            for connection in self._readers:
                connection.close()
            self._readers.clear()

    def _reader(self) -> sqlite3.Connection:
        self._require_open()
        connection: sqlite3.Connection | None = getattr(self._local, "connection", None)
        if connection is None:
            connection = open_read_only(self._path, _SCHEMA)
            self._local.connection = connection
            with self._readers_lock:
                self._readers.append(connection)
        return connection

    def _require_open(self) -> None:
        if self._is_closed:
            raise StorageError(
                f"journal {self._path}: expected an open journal; got a closed one; open it again"
            )


class Journal(JournalReader):
    """The journal of the process that owns the run."""

    def __init__(self, path: Path) -> None:
        """Opens the file for appending, and makes it if it is missing.

        Raises:
            StorageError: It cannot be written, or is damaged, no journal, or of another version.
        """
        self._connection = open_database(path, _SCHEMA)
        super().__init__(path)
        self._next_offset = self.end_offset
        self._requests: queue.SimpleQueue[_Append | None] = queue.SimpleQueue()
        self._pending_bytes = 0
        self._pending = threading.Condition()
        self._writer = threading.Thread(target=self._write, name="journal-writer", daemon=True)
        self._writer.start()

    def wait_for_room(self) -> None:
        """Waits while much more is queued than the disk can take; call it before large appends.

        It is apart from `append` so that no lock need be held meanwhile: commits are told to
        callbacks, which may want that lock.
        """
        with self._pending:
            self._pending.wait_for(
                lambda: self._is_closed or self._pending_bytes < _PENDING_BYTES,
            )

    def append(self, entries: Sequence[tuple[str, bytes]]) -> Future[tuple[Appended, ...]]:
        """Adds entries, all of them or none; returns at once.

        Names that are there already are skipped. Appends of one thread get offsets in the order of
        the calls.

        Args:
            entries: Name and payload of each.

        Returns:
            Resolves after the commit, to the place of each entry; it fails with `StorageError` when
            the disk is full or fails, and then nothing of this call was added.

        Raises:
            StorageError: The journal is closed.
            TypeError: A name is no text, or a payload no bytes.
        """
        _check_types(entries)
        request = _Append(tuple(entries), sum(len(payload) for _, payload in entries), Future())
        with self._pending:
            self._require_open()
            self._pending_bytes += request.size
            self._requests.put(request)
        return request.future

    def close(self) -> None:
        """Commits what is queued, then closes the file; a second call does nothing."""
        with self._pending:
            is_first = not self._is_closed
            self._is_closed = True
            self._pending.notify_all()
            if is_first:
                self._requests.put(None)
        self._writer.join()
        super().close()
        self._connection.close()

    def _write(self) -> None:
        while (first := self._requests.get()) is not None:
            group = self._group(first)
            self._commit([it for it in group if it.future.set_running_or_notify_cancel()])
            with self._pending:
                self._pending_bytes -= sum(request.size for request in group)
                self._pending.notify_all()

    def _group(self, first: _Append) -> list[_Append]:
        """`first` and what has queued up behind it, within the limits of one commit."""
        group, count, size = [first], len(first.entries), first.size
        while count < _GROUP_ENTRIES and size < _GROUP_BYTES:
            try:
                request = self._requests.get_nowait()
            except queue.Empty:
                break
            if request is None:
                self._requests.put(None)  # the end comes after this commit
                break
            group.append(request)
            count += len(request.entries)
            size += request.size
        return group

    def _commit(self, group: Sequence[_Append]) -> None:
        next_offset = self._next_offset
        results: list[tuple[Appended, ...]] = []
        try:
            with storage_errors(_SCHEMA.subject, self._path), transaction(self._connection):
                for request in group:
                    added = [self._insert(name, payload) for name, payload in request.entries]
                    results.append(tuple(added))
        except Exception as error:  # whatever it is, those who wait must hear of it
            self._next_offset = next_offset
            for request in group:
                request.future.set_exception(error)
        else:
            for request, result in zip(group, results, strict=True):
                request.future.set_result(result)

    def _insert(self, name: str, payload: bytes) -> Appended:
        found = self._connection.execute("SELECT offset FROM entries WHERE name = ?", [name])
        if (row := found.fetchone()) is not None:
            return Appended(int(row[0]), is_new=False)
        offset = self._next_offset
        self._connection.execute(
            "INSERT INTO entries VALUES (?, ?, ?, ?)", [offset, name, payload, time.time()]
        )
        self._next_offset += 1
        return Appended(offset, is_new=True)


def _check_types(entries: Sequence[tuple[str, bytes]]) -> None:
    # Found only by SQLite, a wrong type would fail everybody in the same commit.
    for name, payload in entries:
        if not (isinstance(name, str) and isinstance(payload, bytes)):
            raise TypeError(
                f"journal entry: expected bytes under a text name; "
                f"got {type(payload).__name__} under {type(name).__name__}"
            )
