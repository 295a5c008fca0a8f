"""SQLite files that survive `kill -9` and power loss, with errors that a person can act on."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from broker_config.errors import StorageError

_ADVICE = {
    "SQLITE_FULL": "the disk is full; free some space, then try again",
    "SQLITE_BUSY": "another process is writing it; stop that process",
    "SQLITE_LOCKED": "another process is writing it; stop that process",
    "SQLITE_CORRUPT": "the file is damaged; restore it from a recording or a backup",
    "SQLITE_NOTADB": "the file is something else or damaged; choose another path, or restore it",
    "SQLITE_READONLY": "it may not be written; check the permissions of file and folder",
    "SQLITE_CANTOPEN": "check that file and folder exist and may be written (a copy elsewhere "
    "can be read if this folder must stay read-only)",
    "SQLITE_IOERR": "the disk failed or a size limit was reached; check space, quota and disk",
    "ProgrammingError": "it has been closed; open it again",
}


@dataclass(frozen=True)
class Schema:
    """What a kind of file holds, and how such a file is recognised."""

    subject: str
    """What errors call the file."""
    application_id: int
    """SQLite's mark in the file's header, another for each kind of file."""
    version: int
    statements: tuple[str, ...]
    """Make the tables of an empty file."""


def open_database(path: Path, schema: Schema) -> sqlite3.Connection:
    """Opens a file for writing, and makes it if it is missing.

    Each commit is on the disk before it returns (WAL with synchronous=FULL). Transactions are begun
    explicitly. The connection may be handed from thread to thread, but used by one at a time.

    Raises:
        StorageError: The file cannot be opened or written, or it is of another kind or version.
    """
    with storage_errors(schema.subject, path):
        path.parent.mkdir(parents=True, exist_ok=True)
        connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
        try:
            _prepare(connection, path, schema)
        except BaseException:
            connection.close()
            raise
    return connection


def _prepare(connection: sqlite3.Connection, path: Path, schema: Schema) -> None:
    is_new = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
    if not is_new:
        _check_kind(connection, path, schema)  # before anything of a foreign file is changed
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("PRAGMA synchronous=FULL")
    if is_new:
        with transaction(connection):
            for statement in schema.statements:
                connection.execute(statement)
            connection.execute(f"PRAGMA application_id={schema.application_id}")
            connection.execute(f"PRAGMA user_version={schema.version}")


def open_read_only(path: Path, schema: Schema) -> sqlite3.Connection:
    """Opens an existing file for reading, also while another process writes it.

    Raises:
        StorageError: The file is missing or cannot be read, or it is of another kind or version.
    """
    with storage_errors(schema.subject, path):
        connection = sqlite3.connect(
            f"{path.absolute().as_uri()}?mode=ro",
            uri=True,
            isolation_level=None,
            check_same_thread=False,
        )
        try:
            _check_kind(connection, path, schema)
        except BaseException:
            connection.close()
            raise
    return connection


def _check_kind(connection: sqlite3.Connection, path: Path, schema: Schema) -> None:
    application_id = connection.execute("PRAGMA application_id").fetchone()[0]
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if application_id != schema.application_id:
        raise StorageError(
            f"{schema.subject} {path}: expected a clothbus {schema.subject}; "
            f"got another SQLite file (application id {application_id}); choose another path"
        )
    if version != schema.version:
        raise StorageError(
            f"{schema.subject} {path}: expected schema version {schema.version}; got {version}; "
            "open it with the clothbus version that wrote it"
        )


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """Commits what is done inside, or none of it."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        # SQLite itself rolls back when, for example, the disk is full.
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise


@contextmanager
def storage_errors(subject: str, path: Path) -> Iterator[None]:
    """Turns the errors of SQLite and of the file system into `StorageError`."""
    try:
        yield
    except sqlite3.Error as error:
        raise _explained(subject, path, error) from error
    except OSError as error:
        raise StorageError(
            f"{subject} {path}: expected a file that can be used; got {error}; "
            "check path and permissions"
        ) from error


def _explained(subject: str, path: Path, error: sqlite3.Error) -> StorageError:
    code = getattr(error, "sqlite_errorname", None) or type(error).__name__
    advice = next((text for name, text in _ADVICE.items() if code.startswith(name)), None)
    return StorageError(
        f"{subject} {path}: expected a working SQLite file; got {error} ({code}); "
        f"{advice or 'report it with this text'}"
    )
