"""Checkpoints: a trainer's whole state on disk, whole or not at all.

A checkpoint is one safetensors file: the trainer's tensors, and in the header one JSON text with
its counters, the caller's own state and a digest of everything. It is written under another name,
synced and renamed, so that a crash at any moment leaves the earlier checkpoints as they were.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
from torch import Tensor

from broker_config.durable import PARTIAL_SUFFIX, write_durably
from broker_config.errors import StorageError
from learner.trainer import TrainerState

_log = logging.getLogger(__name__)

_NAME = re.compile(r"checkpoint-(\d{8,})\.safetensors")
_HEADER_KEY = "clothbus_checkpoint"
_FORMAT = 1


@dataclass(frozen=True)
class Checkpoint:
    """A state to go on from."""

    state: TrainerState
    extra: dict[str, Any]
    """The caller's own state, as JSON keeps it."""
    path: Path


class CheckpointStore:
    """A folder with the newest few checkpoints of a run; one process writes it."""

    def __init__(self, folder: Path, keep: int = 2) -> None:
        if keep < 1:
            raise StorageError(f"checkpoints.keep: expected at least 1; got {keep}")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(
                f"checkpoints {folder}: expected a folder; got {error}; choose another run folder"
            ) from error
        self._folder = folder
        self._keep = keep

    def save(self, state: TrainerState, extra: Mapping[str, Any]) -> Path:
        """Writes a checkpoint durably, then removes all but the newest few.

        Args:
            state: The trainer's.
            extra: The caller's own state: anything that JSON keeps exactly.

        Raises:
            StorageError: The disk refuses, or `extra` is nothing that JSON keeps.
        """
        data = _serialise(state, extra)
        numbers = self._numbers()
        path = self._path(numbers[-1] + 1 if numbers else 0)
        try:
            write_durably(path, data)
            self._remove_old()
        except OSError as error:
            raise StorageError(
                f"checkpoint {path}: expected to write {len(data)} bytes; got {error}; free disk "
                "space and resume"
            ) from error
        return path

    def latest(self) -> Checkpoint | None:
        """The newest checkpoint that is whole, or None if there has never been one.

        Raises:
            StorageError: There are checkpoints, and none is whole.
        """
        numbers = self._numbers()
        for number in reversed(numbers):
            try:
                return _read(self._path(number))
            except StorageError as error:
                _log.warning("Skipped a damaged checkpoint: %s", error)
        if numbers:
            raise StorageError(
                f"checkpoints {self._folder}: expected one that is whole; got {len(numbers)} "
                "damaged; move them away to train anew from the journal"
            )
        return None

    def _numbers(self) -> list[int]:
        names = (_NAME.fullmatch(path.name) for path in self._folder.iterdir())
        return sorted(int(name[1]) for name in names if name)

    def _path(self, number: int) -> Path:
        return self._folder / f"checkpoint-{number:08d}.safetensors"

    def _remove_old(self) -> None:
        for number in self._numbers()[: -self._keep]:
            self._path(number).unlink(missing_ok=True)
        for partial in self._folder.glob(f"*{PARTIAL_SUFFIX}"):
            partial.unlink(missing_ok=True)  # of a process that died while writing


def _serialise(state: TrainerState, extra: Mapping[str, Any]) -> bytes:
    tensors = dict(state.tensors)
    content = {"format": _FORMAT, "counters": dict(state.counters), "extra": dict(extra)}
    try:
        text = json.dumps(content, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise StorageError(
            f"checkpoint.extra: expected what JSON keeps; got {error}; convert it first"
        ) from error
    # Compared as JSON gives it back: tuples and number keys would silently change.
    if json.loads(text) != content:
        raise StorageError(
            "checkpoint.extra: expected what JSON gives back unchanged; got tuples or keys that "
            "are no text; use lists and text keys"
        )
    header = {_HEADER_KEY: text, "sha256": _digest(tensors, text)}
    return safetensors.torch.save(tensors, header)


def _read(path: Path) -> Checkpoint:
    try:
        data = path.read_bytes()
        tensors = safetensors.torch.load(data)
        header = _header(data)
    except (OSError, safetensors.SafetensorError) as error:
        raise _damaged(path, "a safetensors file", str(error)) from error
    if header.keys() != {_HEADER_KEY, "sha256"}:
        raise _damaged(path, "a checkpoint's header", ", ".join(header) or "none")
    digest = _digest(tensors, header[_HEADER_KEY])
    if digest != header["sha256"]:
        raise _damaged(path, f"digest {header['sha256']}", digest)
    content = json.loads(header[_HEADER_KEY])
    if content["format"] != _FORMAT:
        raise _damaged(path, f"format {_FORMAT}", content["format"])
    return Checkpoint(TrainerState(tensors, content["counters"]), content["extra"], path)


def _header(data: bytes) -> dict[str, str]:
    """The header's texts. The library reads them from files only; the format is 8 bytes of size."""
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size]).get("__metadata__", {})
    return {str(key): str(value) for key, value in header.items()}


def _digest(tensors: Mapping[str, Tensor], text: str) -> str:
    """SHA-256 over the JSON text and over the name, dtype, shape and content of every tensor."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\0{name} {tensor.dtype} {list(tensor.shape)}\0".encode())
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def _damaged(path: Path, rule: str, got: object) -> StorageError:
    return StorageError(f"checkpoint {path}: expected {rule}; got {got}; it is damaged or foreign")
