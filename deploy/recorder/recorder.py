"""The recorder: keeps a copy of a run's journal and of its live traffic as MCAP.

The journalled part is pulled and complete; views, metrics and presence are best effort, with gaps
marked. Everything is written by one thread, the main one.
"""

from __future__ import annotations

import errno
import logging
import threading
import time
from collections.abc import Mapping
from pathlib import Path

from broker_config.bus import Bus
from broker_config.errors import AlreadyOwned, ClothbusError
from broker_config.failpoints import Failpoint, reach
from broker_config.heart import Heart, Pulse
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import JournalEntry, Metrics, Presence, Snapshot, View
from broker_config.recording.recording import SEGMENT_BYTES, Recording
from deploy.recorder.inbox import JournalPart, Live, LostSnapshot, RecorderInbox
from deploy.recorder.journal_follower import JournalFollower

_log = logging.getLogger(__name__)

FLUSH_SECS = 0.5
FLUSH_BYTES = 8 << 20
METRICS_SECS = 2.0
MOST_WAITING = 1024
"""Best-effort messages of a kind that wait to be decoded: two seconds of a busy run."""

TROUBLE_SECS = 5.0
"""Between two tries to write on a disk that is full."""

TOKEN_SECS = 3.0
"""A killed process's token is gone by then."""

WAKE_SECS = 0.1
"""The writing thread looks up at least so often."""

_FULL = {errno.ENOSPC: "disk full", errno.EDQUOT: "disk full", errno.EFBIG: "disk full"}


class Recorder:
    """One recorder process; `run` returns when the run is over and recorded, or on `stop`.

    Attributes:
        state: What it is doing, as its heartbeats say.
    """

    def __init__(
        self,
        bus: Bus,
        name: str,
        folder: Path,
        incarnation: str,
        segment_bytes: int = SEGMENT_BYTES,
    ) -> None:
        """Prepares a recorder.

        Args:
            bus: Its place on the bus, under the same name.
            name: The recorder's.
            folder: Of the recording, which the caller has locked.
            incarnation: Of this process; another for every start.
            segment_bytes: Size at which another file is begun.
        """
        self._bus = bus
        self._name = name
        self._folder = folder
        self._incarnation = incarnation
        self._segment_bytes = segment_bytes
        self._inbox = RecorderInbox()
        self._pulse = Pulse()
        self._stop = threading.Event()
        self._recording: Recording | None = None
        self._follower: JournalFollower | None = None
        self._has_all = False
        self._metrics = bus.publisher(bus.keys.metrics("recorder", name))
        self._metrics_sent = 0
        self._next_metrics_secs = 0.0
        self._next_flush_secs = 0.0
        self._next_offset = 0
        self._gaps = 0
        self._written_bytes = 0
        self.state = "starting"

    def stop(self) -> None:
        """Asks the recorder to finish its file and leave; safe in a signal handler."""
        self._stop.set()

    def run(self) -> bool:
        """Records.

        Returns:
            Whether the run is over and wholly recorded; False after `stop`.

        Raises:
            AlreadyOwned: Another recorder of this name follows the run.
            AttachRefused: The owner's versions differ.
            StorageError: The folder holds something that must not be touched.
        """
        self._refuse_second_recorder()
        self._subscribe()
        heart = Heart(
            self._bus, "recorder", self._name, self._incarnation, self.vitals, self._pulse
        )
        with heart:
            while not self._stop.is_set():
                try:
                    self.state = "opening the recording"
                    with self._open() as recording:
                        if self._has_all:  # the disk was full when the file was to be finished
                            recording.finish()
                            return True
                        return self._record(recording)
                except OSError as error:
                    self._wait_out(error)
        return False

    # Joining ----------------------------------------------------------------------------------

    def _refuse_second_recorder(self) -> None:
        """Two recorders of one name would each seem to hold what the other does."""
        deadline_secs = time.monotonic() + TOKEN_SECS
        while any((key.role, key.id) == ("recorder", self._name) for key in self._bus.alive()):
            if time.monotonic() > deadline_secs:
                raise AlreadyOwned(
                    f"recorder {self._name}: expected no other of this name on run "
                    f"{self._bus.keys.run}; got one; choose another --id, or end the other first"
                )
            self._stop.wait(WAKE_SECS)

    def _subscribe(self) -> None:
        keys = self._bus.keys
        self._bus.subscribe(keys.every(Kind.VIEW), View, self._take_live, MOST_WAITING)
        self._bus.subscribe(keys.every(Kind.METRICS), Metrics, self._take_live, MOST_WAITING)
        self._bus.watch_alive(self._take_presence)

    def _take_live(self, _: ParsedKey, message: View | Metrics) -> None:
        self._inbox.offer(message)

    def _take_presence(self, key: ParsedKey, is_alive: bool) -> None:
        if key.role is not None and key.id is not None:
            self._inbox.offer(Presence(key.role, key.id, is_alive))

    # Writing ----------------------------------------------------------------------------------

    def _open(self) -> Recording:
        recording = Recording(
            self._folder, self._bus.keys.run, self._incarnation, self._segment_bytes, self._beat
        )
        _log.info("Recording into %s from journal entry %d", self._folder, recording.next_offset)
        return recording

    def _beat(self) -> None:
        self._pulse.beat()

    def _record(self, recording: Recording) -> bool:
        follower = JournalFollower(self._bus, self._name, self._incarnation, recording, self._inbox)
        self._recording, self._follower = recording, follower
        self.state = "recording"
        try:
            with follower:
                while not (self._stop.is_set() or follower.has_finished):
                    self._pulse.beat()
                    if follower.failure is not None:
                        raise follower.failure
                    self._write_some(recording)
                self._finish(recording)
            return self._has_all
        except ClothbusError:
            recording.finish()  # what is written is right
            raise
        finally:
            self._next_offset = recording.next_offset
            self._gaps += recording.gaps
            self._written_bytes += recording.written_bytes
            self._recording = None

    def _finish(self, recording: Recording) -> None:
        if self._follower is not None:
            self._has_all = self._follower.has_finished
        self.state = "finishing"
        self._write(recording, *self._inbox.take(0.0))
        recording.finish()

    def _write_some(self, recording: Recording) -> None:
        self._write(recording, *self._inbox.take(WAKE_SECS))
        now_secs = time.monotonic()
        is_large = recording.unflushed_bytes >= FLUSH_BYTES
        if is_large or (recording.unflushed_bytes and now_secs >= self._next_flush_secs):
            recording.flush()
            reach(Failpoint.BATCH_HELD)
            self._next_flush_secs = now_secs + FLUSH_SECS
        if now_secs >= self._next_metrics_secs:
            self._send_metrics(recording.next_offset)
            self._next_metrics_secs = now_secs + METRICS_SECS

    def _write(self, recording: Recording, live: list[Live], part: JournalPart | None) -> None:
        for message in live:
            recording.add_live(message)
        if part is None:
            return
        for item in part.items:
            match item:
                case JournalEntry():
                    recording.add_entry(item)
                case Snapshot():
                    recording.add_snapshot(item)
                case LostSnapshot():
                    recording.add_lost_snapshot(item.version)
        if part.end_of_batch:
            reach(Failpoint.BATCH_WRITTEN)

    def _wait_out(self, error: OSError) -> None:
        """Says what is wrong and pauses; what the journal has will be asked for again."""
        kind = _FULL.get(error.errno or 0, "cannot write")
        self.state = f"{kind}: {error}"
        _log.error("%s; trying again, nothing of the journal is lost", self.state)
        deadline_secs = time.monotonic() + TROUBLE_SECS
        while time.monotonic() < deadline_secs and not self._stop.wait(WAKE_SECS):
            self._pulse.beat()

    # What it says of itself -------------------------------------------------------------------

    def vitals(self) -> tuple[str, Mapping[str, float]]:
        """State and numbers."""
        follower = self._follower
        is_waiting = follower is not None and follower.is_waiting and self.state == "recording"
        return ("waiting for the owner" if is_waiting else self.state), self.numbers()

    def numbers(self) -> dict[str, float]:
        """How far it is, as its heartbeats and metrics say."""
        recording, follower = self._recording, self._follower
        next_offset = recording.next_offset if recording else self._next_offset
        end_offset = follower.end_offset if follower else 0
        return {
            "next_offset": next_offset,
            "behind": max(0, end_offset - next_offset),
            "gaps": self._gaps + (recording.gaps if recording else 0),
            "dropped": self._inbox.dropped,
            "bytes": self._written_bytes + (recording.written_bytes if recording else 0),
        }

    def _send_metrics(self, step: int) -> None:
        self._metrics.put(
            Metrics(
                "recorder",
                self._name,
                self._incarnation,
                self._metrics_sent,
                step,
                self.numbers(),
            )
        )
        self._metrics_sent += 1
