"""The spool: what an actor has done and the owner has not yet acknowledged, on the actor's disk.

A simulator puts whole episodes. A robot writes each step before it moves on (`begin`,
`append_step`, `finish`); after a crash `recover` turns the finished steps into an interrupted
trajectory. Everything is on the disk before a call returns.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgpack
import numpy as np
from numpy.typing import NDArray

from broker_config.closing import Closing
from broker_config.codec import SIZE_LIMITS, encode
from broker_config.database import Schema, open_database, storage_errors, transaction
from broker_config.errors import MessageError, SpoolFull, StorageError
from broker_config.messages import Ticket, Trajectory, TrajectoryId, require_id
from broker_config.ownership import FileLock
from broker_config.structure import from_plain, to_plain

_SCHEMA = Schema(
    subject="spool",
    application_id=0x636C6F73,  # "clos"
    version=1,
    statements=(
        "CREATE TABLE spool (run TEXT NOT NULL, actor TEXT NOT NULL,"
        " next_sequence INTEGER NOT NULL)",
        "CREATE TABLE outbox (sequence INTEGER PRIMARY KEY, incarnation TEXT NOT NULL,"
        " payload BLOB NOT NULL)",
        # At most one episode is open: the robot acts in one place at a time.
        "CREATE TABLE episode (only INTEGER PRIMARY KEY CHECK (only = 0),"
        " sequence INTEGER NOT NULL, incarnation TEXT NOT NULL, ticket BLOB NOT NULL,"
        " height INTEGER NOT NULL, width INTEGER NOT NULL, channels INTEGER NOT NULL,"
        " first_observation BLOB NOT NULL, reserved_bytes INTEGER NOT NULL)",
        "CREATE TABLE steps (step INTEGER PRIMARY KEY, action INTEGER NOT NULL,"
        " reward REAL NOT NULL, observation BLOB NOT NULL, unix_secs REAL NOT NULL,"
        " terminated INTEGER NOT NULL, success INTEGER NOT NULL, guard TEXT)",
    ),
)
_OVERHEAD_BYTES = 4096
"""Of a trajectory's payload besides observations, actions and rewards; generously."""
_STEP_NUMBERS_BYTES = 8
"""Action and reward of one step in a payload."""


@dataclass(frozen=True)
class Spooled:
    """A trajectory that waits for its acknowledgement."""

    id: TrajectoryId
    payload: bytes
    """The encoded `Trajectory`, to be sent as it is."""


@dataclass(frozen=True)
class SpoolStatus:
    """How full a spool is."""

    trajectories: int
    open_steps: int
    """Finished steps of the episode that is open, 0 without one."""
    used_bytes: int
    """Of waiting trajectories, and what is reserved for the open episode."""
    max_bytes: int


class Spool(Closing):
    """The spool of one actor; threads may share it.

    Sequence numbers go on across restarts and never repeat.
    """

    def __init__(self, path: Path, run: str, actor: str, incarnation: str, max_bytes: int) -> None:
        """Opens the spool, and makes it if it is missing.

        Args:
            path: The SQLite file.
            run: For which run; its trajectories mean nothing to another.
            actor: Whose trajectories it holds.
            incarnation: Of the process that acts now; part of every new trajectory's id.
            max_bytes: How much may wait.

        Raises:
            MessageError: Run, actor or incarnation are no ids.
            AlreadyOwned: Another process has the spool open.
            StorageError: The file cannot be used, or belongs to another actor or run.
        """
        self._path = path
        self._run = require_id("spool's run", run)
        self._actor = require_id("spool's actor", actor)
        self._incarnation = require_id("spool's incarnation", incarnation)
        self._max_bytes = max_bytes
        self._lock = threading.RLock()
        with contextlib.ExitStack() as undo:
            self._file_lock = FileLock(path.with_name(path.name + ".lock"), f"spool {path}")
            undo.callback(self._file_lock.close)
            self._connection = open_database(path, _SCHEMA)
            undo.callback(self._connection.close)
            self._claim()
            undo.pop_all()

    def _claim(self) -> None:
        with storage_errors(_SCHEMA.subject, self._path), transaction(self._connection):
            row = self._connection.execute("SELECT run, actor FROM spool").fetchone()
            if row is None:
                self._connection.execute(
                    "INSERT INTO spool VALUES (?, ?, 0)", [self._run, self._actor]
                )
            elif row != (self._run, self._actor):
                raise StorageError(
                    f"spool {self._path}: expected the spool of {self._actor} in run {self._run}; "
                    f"got that of {row[1]} in run {row[0]}; give every actor a spool of its own "
                    "for each run"
                )

    def next_id(self) -> TrajectoryId:
        """Reserves the id of the next trajectory; it is never given again.

        Raises:
            StorageError: The disk is full or fails.
        """
        with self._changing():
            row = self._connection.execute(
                "UPDATE spool SET next_sequence = next_sequence + 1 RETURNING next_sequence - 1"
            ).fetchone()
        return TrajectoryId(self._actor, self._incarnation, int(row[0]))

    def put(self, trajectory: Trajectory) -> None:
        """Adds a whole episode; adding it again changes nothing.

        Raises:
            SpoolFull: Too much waits already.
            StorageError: The disk is full or fails.
            MessageError: The id is of another actor, or the trajectory is too large for the bus.
        """
        self._check_id(trajectory.id)
        payload = encode(trajectory)
        with self._changing():
            self._require_room(len(payload))
            self._insert(trajectory.id, payload)

    def begin(
        self, trajectory_id: TrajectoryId, ticket: Ticket, first_observation: NDArray[np.uint8]
    ) -> None:
        """Opens an episode that is written step by step, and reserves room for all its steps.

        Args:
            trajectory_id: From `next_id`.
            ticket: What is collected.
            first_observation: u8[H, W, C].

        Raises:
            SpoolFull: The ticket's steps might not fit; better known before the robot moves.
            StorageError: An episode is open already, or the disk is full or fails.
            MessageError: The id is of another actor, the observation is no picture, or the whole
                trajectory would be too large for the bus.
        """
        self._check_id(trajectory_id)
        shape = _picture_shape(first_observation)
        reserved = _payload_bound(ticket.steps, first_observation.nbytes)
        with self._changing():
            self._require_no_episode()
            self._require_room(reserved)
            self._connection.execute(
                "INSERT INTO episode VALUES (0, ?, ?, ?, ?, ?, ?, ?, ?)",
                [
                    trajectory_id.sequence,
                    trajectory_id.incarnation,
                    msgpack.packb(to_plain(ticket)),
                    *shape,
                    first_observation.tobytes(),
                    reserved,
                ],
            )

    def append_step(
        self,
        action: int,
        reward: float,
        observation: NDArray[np.uint8],
        *,
        terminated: bool = False,
        success: bool = False,
        guard: str | None = None,
    ) -> None:
        """Writes a step of the open episode, with all that is known of it.

        Args:
            action: The index that was carried out.
            reward: What it earned.
            observation: u8[H, W, C] after it, of the first one's shape.
            terminated: Whether it ended the task.
            success: Whether the task counts as solved after it.
            guard: Why the step must not be learned from.

        Raises:
            StorageError: No episode is open, or the disk is full or fails.
            MessageError: The observation has another shape than the first, or action or reward are
                no numbers of a trajectory.
        """
        shape = _picture_shape(observation)
        _check_step(action, reward)
        with self._changing():
            expected = self._open_shape()
            if shape != expected:
                raise MessageError(
                    f"observation: expected uint8 {list(expected)} as at the episode's start; "
                    f"got {list(shape)}; a camera's settings have changed"
                )
            self._connection.execute(
                "INSERT INTO steps (action, reward, observation, unix_secs, terminated, success,"
                " guard) VALUES (?, ?, ?, ?, ?, ?, ?)",
                [
                    int(action),
                    float(reward),
                    observation.tobytes(),
                    time.time(),
                    terminated,
                    success,
                    guard,
                ],
            )

    def finish(self) -> Trajectory | None:
        """Closes the open episode and moves it to the trajectories that wait.

        Returns:
            The trajectory, or None if no step was finished: nothing happened, nothing is sent.

        Raises:
            StorageError: No episode is open, or the disk is full or fails.
        """
        with self._changing():
            self._open_shape()
            return self._close_episode(interrupted=False)

    def recover(self) -> Trajectory | None:
        """Closes an episode that a crash left open; call it before the first `begin`.

        Returns:
            The interrupted trajectory, which now waits with the others; None if no episode was open
            or none of its steps was finished.

        Raises:
            StorageError: The disk is full or fails.
        """
        with self._changing():
            if self._connection.execute("SELECT 1 FROM episode").fetchone() is None:
                return None
            return self._close_episode(interrupted=True)

    def pending(self) -> Iterator[Spooled]:
        """What waits, oldest first, one payload in memory at a time.

        Trajectories that arrive or are acknowledged during the iteration are taken into account.
        """
        last = -1
        while True:
            with self._lock, storage_errors(_SCHEMA.subject, self._path):
                row = self._connection.execute(
                    "SELECT sequence, incarnation, payload FROM outbox WHERE sequence > ?"
                    " ORDER BY sequence LIMIT 1",
                    [last],
                ).fetchone()
            if row is None:
                return
            last = int(row[0])
            yield Spooled(TrajectoryId(self._actor, row[1], last), row[2])

    def acknowledge(self, trajectory_id: TrajectoryId) -> bool:
        """Forgets a trajectory that the owner has committed.

        Returns:
            Whether it was waiting; a second acknowledgement changes nothing.

        Raises:
            StorageError: The disk fails.
        """
        with self._changing():
            cursor = self._connection.execute(
                "DELETE FROM outbox WHERE sequence = ? AND incarnation = ?",
                [trajectory_id.sequence, trajectory_id.incarnation],
            )
        return cursor.rowcount == 1

    def status(self) -> SpoolStatus:
        """How full it is."""
        with self._lock, storage_errors(_SCHEMA.subject, self._path):
            trajectories = self._connection.execute("SELECT count(*) FROM outbox").fetchone()[0]
            steps = self._connection.execute("SELECT count(*) FROM steps").fetchone()[0]
            return SpoolStatus(trajectories, steps, self._used_bytes(), self._max_bytes)

    def close(self) -> None:
        """Closes the file; an open episode stays for `recover`. A second call does nothing."""
        with self._lock:
            self._connection.close()
            self._file_lock.close()

    @contextlib.contextmanager
    def _changing(self) -> Iterator[None]:
        with (
            self._lock,
            storage_errors(_SCHEMA.subject, self._path),
            transaction(self._connection),
        ):
            yield

    def _insert(self, trajectory_id: TrajectoryId, payload: bytes) -> None:
        self._connection.execute(
            "INSERT OR IGNORE INTO outbox VALUES (?, ?, ?)",
            [trajectory_id.sequence, trajectory_id.incarnation, payload],
        )

    def _close_episode(self, interrupted: bool) -> Trajectory | None:
        steps = self._connection.execute(
            "SELECT action, reward, observation, unix_secs, terminated, success, guard"
            " FROM steps ORDER BY step"
        ).fetchall()
        trajectory = None
        if steps:
            sequence, incarnation, ticket, *shape, first = self._connection.execute(
                "SELECT sequence, incarnation, ticket, height, width, channels, first_observation"
                " FROM episode"
            ).fetchone()
            pictures = b"".join([first, *(step[2] for step in steps)])
            trajectory = Trajectory(
                id=TrajectoryId(self._actor, incarnation, sequence),
                ticket=from_plain(msgpack.unpackb(ticket), Ticket, "ticket"),
                observations=np.frombuffer(pictures, np.uint8).reshape(len(steps) + 1, *shape),
                actions=np.array([step[0] for step in steps], np.int32),
                rewards=np.array([step[1] for step in steps], np.float32),
                terminated=bool(steps[-1][4]),
                truncated=not steps[-1][4],
                success=bool(steps[-1][5]),
                guard=steps[-1][6],
                interrupted=interrupted,
                ended_unix_secs=steps[-1][3],
            )
            self._insert(trajectory.id, encode(trajectory))
        self._connection.execute("DELETE FROM steps")
        self._connection.execute("DELETE FROM episode")
        return trajectory

    def _open_shape(self) -> tuple[int, int, int]:
        row = self._connection.execute("SELECT height, width, channels FROM episode").fetchone()
        if row is None:
            raise StorageError(
                f"spool {self._path}: expected an open episode; got none; call begin first"
            )
        return (row[0], row[1], row[2])

    def _require_no_episode(self) -> None:
        if self._connection.execute("SELECT 1 FROM episode").fetchone() is not None:
            raise StorageError(
                f"spool {self._path}: expected no open episode; got one; finish it, or recover it "
                "after a crash"
            )

    def _require_room(self, needed: int) -> None:
        used = self._used_bytes()
        if used + needed > self._max_bytes:
            raise SpoolFull(
                f"spool {self._path}: expected room for {needed} bytes; got {used} of "
                f"{self._max_bytes} used; wait until the owner has acknowledged some, or raise the "
                "limit"
            )

    def _used_bytes(self) -> int:
        row = self._connection.execute(
            "SELECT (SELECT ifnull(sum(length(payload)), 0) FROM outbox)"
            " + (SELECT ifnull(sum(reserved_bytes), 0) FROM episode)"
        ).fetchone()
        return int(row[0])

    def _check_id(self, trajectory_id: TrajectoryId) -> None:
        if (trajectory_id.actor, trajectory_id.incarnation) != (self._actor, self._incarnation):
            raise MessageError(
                f"trajectory id: expected one of {self._actor}/{self._incarnation}; "
                f"got {trajectory_id}; take it from next_id"
            )


def _picture_shape(observation: NDArray[np.uint8]) -> tuple[int, int, int]:
    if observation.dtype != np.uint8 or observation.ndim != 3:
        raise MessageError(
            f"observation: expected uint8 [H, W, C]; "
            f"got {observation.dtype} {list(observation.shape)}"
        )
    height, width, channels = observation.shape
    return height, width, channels


def _payload_bound(steps: int, observation_bytes: int) -> int:
    """Bytes that no trajectory of so many steps exceeds."""
    bound = _OVERHEAD_BYTES + (steps + 1) * (observation_bytes + _STEP_NUMBERS_BYTES)
    if bound > SIZE_LIMITS[Trajectory]:
        raise MessageError(
            f"ticket.steps: expected a trajectory of at most {SIZE_LIMITS[Trajectory]} bytes; got "
            f"{steps} steps of {observation_bytes} bytes; choose a shorter horizon"
        )
    return bound


def _check_step(action: int, reward: float) -> None:
    if not 0 <= action < 2**31:
        raise MessageError(f"action: expected an index of 0 or more; got {action}")
    if not np.isfinite(np.float32(reward)):
        raise MessageError(f"reward: expected a finite number; got {reward}")
