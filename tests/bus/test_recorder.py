"""The recorder against a real owner's journal: complete, exactly once, with gaps marked."""

from __future__ import annotations

import contextlib
import errno
import itertools
import resource
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from broker_config.bus import Bus
from broker_config.errors import AlreadyOwned, ClothbusError, StorageError
from broker_config.journal import Journal
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import (
    Attach,
    Heartbeat,
    JournalRequest,
    Metrics,
    Presence,
    RecordingGap,
    Refusal,
    Snapshot,
    SnapshotRequest,
    SnapshotTaken,
    View,
    weights_digest,
)
from broker_config.queries import Responder
from broker_config.recording.recording import Recording, iter_recording
from deploy.presets import load_preset
from deploy.recorder.recorder import Recorder
from learner.owner import Owner
from tests.conftest import until_declared
from tests.process.recorded import settle_recording

PRESET = load_preset("reaching-smoke")
WAIT_SECS = 30.0


class Host:
    """An owner that serves its journal and its policies, and does not learn."""

    def __init__(self, bus: Bus, run: str, path: Path) -> None:
        self.path = path
        self.journal = Journal(path)
        self.owner = Owner(run, PRESET, self.journal)
        self.weights: dict[int, bytes] = {}
        self.held: list[int] = []
        bus.serve(bus.keys.every(Kind.ATTACH), Attach, self._attach)
        bus.serve(bus.keys.every(Kind.JOURNAL), JournalRequest, self._follow)
        bus.serve(bus.keys.every(Kind.POLICY_VERSION), SnapshotRequest, self._snapshot)
        bus.declare_alive()

    def append(self, *payloads: bytes) -> None:
        """Adds entries that look like trajectories."""
        start = self.journal.end_offset
        names = [f"trajectory/actor-0/life/{start + n}" for n in range(len(payloads))]
        self.journal.append(list(zip(names, payloads, strict=True))).result(WAIT_SECS)

    def take(self, version: int, size: int = 1000) -> None:
        """Journals a policy."""
        weights = np.random.default_rng(version).bytes(size)
        self.weights[version] = weights
        self.owner.policy_ready(SnapshotTaken(version, weights_digest(weights), 0))

    def finish(self) -> None:
        """Ends the run."""
        self.owner.close_record()

    def _attach(self, _: ParsedKey, request: Attach, to: Responder) -> None:
        to.reply(self.owner.attach(request))

    def _follow(self, _: ParsedKey, request: JournalRequest, to: Responder) -> None:
        self.held.append(request.held_offset)
        to.reply(self.owner.follow(request, 32 << 20, time.monotonic()))

    def _snapshot(self, _: ParsedKey, request: SnapshotRequest, to: Responder) -> None:
        weights = self.weights.get(request.version)
        if weights is None:
            to.reply(Refusal("policy version", "another", str(request.version), "ask again"))
            return
        spec = PRESET.network
        to.reply(Snapshot(request.version, 1, spec, weights, weights_digest(weights)))


class Running:
    """A recorder on a thread of its own."""

    def __init__(self, recorder: Recorder) -> None:
        self.recorder = recorder
        self.outcome: bool | ClothbusError | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.outcome = self.recorder.run()
        except ClothbusError as error:
            self.outcome = error

    def wait(self) -> bool | ClothbusError | None:
        self._thread.join(WAIT_SECS)
        assert not self._thread.is_alive(), f"still {self.recorder.state}"
        return self.outcome

    def close(self) -> None:
        self.recorder.stop()
        self._thread.join(WAIT_SECS)


Start = Callable[..., Running]


@pytest.fixture
def host(attach: Any, run_name: str, tmp_path: Path) -> Iterator[Host]:
    made = Host(attach("owner", "learner"), run_name, tmp_path / "journal.sqlite")
    yield made
    made.journal.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "recording"
    made.mkdir()
    return made


@pytest.fixture
def start(attach: Any, folder: Path) -> Iterator[Start]:
    """Starts recorders into the folder, and ends them with the test."""
    with contextlib.ExitStack() as stack:

        def start_one(life: str = "rec-1", name: str = "recorder", **options: Any) -> Running:
            running = Running(Recorder(attach("recorder", name), name, folder, life, **options))
            stack.callback(running.close)
            return running

        yield start_one


def gaps(folder: Path) -> list[RecordingGap]:
    found = [item.decode() for item in iter_recording(folder, ["gap"])]
    assert all(isinstance(it, RecordingGap) for it in found)
    return [it for it in found if isinstance(it, RecordingGap)]


def view(sequence: int, incarnation: str = "life", picture: bytes = b"png") -> View:
    return View("actor-0", incarnation, sequence, 0, 0, 0, 0, None, None, picture, "png", 1.0)


def test_the_journal_and_its_policies_are_recorded_once_and_wholly(
    host: Host, start: Start, folder: Path, wait_until: Callable[..., None]
) -> None:
    payloads = [np.random.default_rng(n).bytes(700_000) for n in range(20)]
    host.take(0)
    host.append(*payloads[:12])  # more than one batch
    running = start()
    host.take(1, 3_000_000)
    host.take(2)
    host.append(*payloads[12:])
    wait_until(lambda: host.held and host.held[-1] == host.journal.end_offset, "all is held")
    assert host.owner.followers.missing_versions() == frozenset()
    host.finish()
    assert running.wait() is True
    account = settle_recording(folder, host.path)
    assert (account.trajectories, account.snapshots, account.segments) == (20, 3, 1)
    assert account.topics["journal/follower"] == 1
    assert host.held == sorted(host.held)


def test_a_stopped_recorder_finishes_its_file_and_the_next_goes_on(
    host: Host, start: Start, folder: Path, wait_until: Callable[..., None]
) -> None:
    host.take(0)
    host.append(b"one", b"two")
    first = start("rec-1")
    wait_until(lambda: host.held and host.held[-1] >= 4, "something is held")
    first.recorder.stop()
    assert first.wait() is False
    assert sum(1 for _ in iter_recording(folder, ["journal/"])) >= 4
    host.append(b"three")
    host.take(1)
    second = start("rec-2", name="recorder-2")
    host.finish()
    assert second.wait() is True
    account = settle_recording(folder, host.path)
    assert (account.trajectories, account.snapshots, account.segments) == (3, 2, 2)


def test_small_segments_follow_each_other(host: Host, start: Start, folder: Path) -> None:
    for number in range(6):
        host.append(np.random.default_rng(number).bytes(1_500_000))
    running = start(segment_bytes=1 << 20)
    host.finish()
    assert running.wait() is True
    account = settle_recording(folder, host.path)
    assert account.trajectories == 6
    assert account.segments >= 2


def test_an_owner_that_comes_back_is_followed_further(
    attach: Any, run_name: str, tmp_path: Path, start: Start, folder: Path, wait_until: Any
) -> None:
    path = tmp_path / "journal.sqlite"
    first_bus = attach("owner", "learner")
    first = Host(first_bus, run_name, path)
    first.append(b"one")
    running = start()
    wait_until(lambda: first.held and first.held[-1] == first.journal.end_offset, "all is held")
    first_bus.close()
    first.journal.close()
    wait_until(lambda: _state(running) == "waiting for the owner", "the owner is missed")
    second = Host(attach("owner", "learner"), run_name, path)
    second.append(b"two")
    second.finish()
    assert running.wait() is True
    account = settle_recording(folder, path)
    assert account.trajectories == 2
    assert account.topics["journal/run"] == 2
    second.journal.close()


def _state(running: Running) -> str:
    state, _ = running.recorder.vitals()
    return state


def test_a_policy_that_is_gone_is_marked_and_holds_up_nothing(
    host: Host, start: Start, folder: Path
) -> None:
    host.take(0)
    host.take(1)
    host.take(2)
    del host.weights[1]
    host.weights[2] = b"others took its place"
    host.append(b"one")
    running = start()
    host.finish()
    assert running.wait() is True
    assert gaps(folder) == [
        RecordingGap("policy/1", "rec-1", 1, 1),
        RecordingGap("policy/2", "rec-1", 2, 1),
    ]
    assert sum(1 for _ in iter_recording(folder, ["journal/"])) == host.journal.end_offset
    with pytest.raises(AssertionError, match="no weights"):
        settle_recording(folder, host.path)


def test_views_metrics_and_presence_are_recorded_and_dropped_ones_marked(
    attach: Any, host: Host, start: Start, folder: Path, wait_until: Callable[..., None]
) -> None:
    running = start()
    wait_until(lambda: host.held and host.held[-1] > 0, "the recorder follows")
    actor = attach("actor", "actor-0")
    actor.declare_alive()
    views = actor.publisher(actor.keys.view("actor-0"))
    metrics = actor.publisher(actor.keys.metrics("actor", "actor-0"))
    until_declared(actor)
    for sequence in (0, 1, 5):
        views.put(view(sequence))
    metrics.put(Metrics("actor", "actor-0", "life", 0, 3, {"steps": 7.0}))
    views.put(view(2, "next-life"))
    wait_until(lambda: running.recorder.numbers()["gaps"] == 2, "two gaps")
    host.finish()
    assert running.wait() is True
    assert gaps(folder) == [
        RecordingGap("view/actor-0", "life", 2, 3),
        RecordingGap("view/actor-0", "next-life", 0, 2),
    ]
    found = [item.decode() for item in iter_recording(folder, ["view/actor-0"])]
    assert found == [view(0), view(1), view(5), view(2, "next-life")]
    present = [item.decode() for item in iter_recording(folder, ["presence"])]
    assert Presence("actor", "actor-0", is_alive=True) in present
    assert Presence("owner", "learner", is_alive=True) in present
    topics = {item.topic for item in iter_recording(folder)}
    assert {"metrics/actor/actor-0", "metrics/recorder/recorder", "view/actor-0/image"} <= topics
    assert {"metrics/actor/actor-0/steps", "metrics/recorder/recorder/behind"} <= topics


def test_a_flood_of_views_is_dropped_in_part_and_the_journal_is_whole(
    attach: Any,
    host: Host,
    start: Start,
    folder: Path,
    wait_until: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("deploy.recorder.inbox.RecorderInbox.__init__.__defaults__", (100_000,))
    running = start()
    wait_until(lambda: host.held and host.held[-1] > 0, "the recorder follows")
    actor = attach("actor", "actor-0")
    views = actor.publisher(actor.keys.view("actor-0"))
    picture = np.random.default_rng(0).bytes(60_000)
    for sequence in range(300):
        views.put(view(sequence, picture=picture))
        if sequence % 30 == 0:
            host.append(picture)
    views.put(view(300))
    host.finish()
    assert running.wait() is True
    account = settle_recording(folder, host.path)
    assert account.trajectories == 10
    recorded = [item.sequence for item in iter_recording(folder, ["view/actor-0"])]
    assert recorded == sorted(set(recorded))
    last = recorded[-1] if recorded else -1
    assert len(recorded) + account.missing_live == last + 1


@contextlib.contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Lets no file of this process grow beyond a size, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_said_and_loses_nothing_of_the_journal(
    attach: Any,
    host: Host,
    start: Start,
    folder: Path,
    wait_until: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("deploy.recorder.recorder.TROUBLE_SECS", 1.2)
    states: list[str] = []
    observer = attach("observer", "watching")
    key = observer.keys.live("recorder", "recorder")
    observer.subscribe(key, Heartbeat, lambda _, beat: states.append(beat.state))
    until_declared(observer)
    host.take(0)
    running = start()
    wait_until(lambda: host.held and host.held[-1] > 0, "the recorder follows")
    actor = attach("actor", "actor-0")
    views = actor.publisher(actor.keys.view("actor-0"))
    sequences = itertools.count()

    def is_said() -> bool:
        # Best effort: of a burst, a busy link drops most.
        sequence = next(sequences)
        views.put(view(sequence, picture=np.random.default_rng(sequence).bytes(60_000)))
        return any(state.startswith("disk full: [Errno 27]") for state in states)

    with largest_file(600_000):  # the journal is smaller
        host.append(b"one", b"two")
        wait_until(is_said, "it says so")
        host.append(b"three")
    host.finish()
    assert running.wait() is True
    account = settle_recording(folder, host.path)
    assert (account.trajectories, account.snapshots) == (3, 1)


def test_a_disk_that_is_full_at_the_very_end_does_not_keep_the_recorder(
    attach: Any,
    host: Host,
    start: Start,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("deploy.recorder.recorder.TROUBLE_SECS", 0.1)
    finish, failures = Recording.finish, [OSError(errno.ENOSPC, "No space left on device")]

    def fail_once(recording: Recording) -> None:
        if failures:
            raise failures.pop()
        finish(recording)

    monkeypatch.setattr(Recording, "finish", fail_once)
    host.append(b"one")
    running = start()
    host.finish()
    assert running.wait() is True
    assert failures == []
    assert settle_recording(folder, host.path).trajectories == 1


def test_a_second_recorder_of_the_same_name_is_refused(
    host: Host, start: Start, wait_until: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deploy.recorder.recorder.TOKEN_SECS", 0.3)
    start()
    wait_until(lambda: host.held and host.held[-1] > 0, "the recorder follows")
    refusal = start("rec-2").wait()
    assert isinstance(refusal, AlreadyOwned)
    assert "expected no other of this name" in str(refusal)


def test_a_shorter_journal_is_another_one(
    attach: Any, host: Host, start: Start, tmp_path: Path, run_name: str, wait_until: Any
) -> None:
    host.append(*[b"x"] * 5)
    running = start()
    host.finish()
    assert running.wait() is True
    host_bus = attach("owner", "other")
    other = Host(host_bus, run_name + "-2", tmp_path / "other.sqlite")
    other.journal.close()
    host.journal.close()
    host.journal = Journal(tmp_path / "other.sqlite")
    host.owner = Owner(run_name, PRESET, host.journal)
    refusal = start("rec-2", name="recorder-2").wait()
    assert isinstance(refusal, StorageError)
    assert "expected at least the 7 entries that are recorded" in str(refusal)
