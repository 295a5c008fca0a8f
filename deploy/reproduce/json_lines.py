"""Files of numbers, an object a line: small, in the repository, and whole or not there."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from broker_config.durable import write_durably
from broker_config.errors import MessageError, StorageError
from broker_config.structure import from_plain, to_plain

T = TypeVar("T")


def read_lines(path: Path, kind: type[T], what: str) -> list[T]:
    """Reads what `write_lines` wrote; nothing where there is no file.

    Args:
        path: Of the file.
        kind: Dataclass of its lines.
        what: They are, for errors.

    Raises:
        StorageError: The file holds something else.
    """
    if not path.exists():
        return []
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise StorageError(f"{path}: expected {what}; got {error}; move it away") from error
    read = []
    for number, line in enumerate(lines, start=1):
        try:
            read.append(from_plain(json.loads(line), kind, f"{path.name}:{number}"))
        except (ValueError, MessageError) as error:
            raise StorageError(
                f"{path}: expected {what}; got line {number}: {error}; move it away"
            ) from error
    return read


def write_lines(path: Path, items: Iterable[object]) -> None:
    """Writes dataclasses in the given order; a reader sees the whole file or none.

    Raises:
        StorageError: The disk refuses.
    """
    lines = [json.dumps(to_plain(item)) + "\n" for item in items]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, "".join(lines).encode())
    except OSError as error:
        raise StorageError(f"{path}: expected to write {len(lines)} lines; got {error}") from error
