"""Published messages, liveliness and rejects through a real router."""

import hashlib
import signal
import subprocess
import sys
import threading
import time

import pytest
import zenoh

from broker_config.codec import SCHEMA_VERSION
from broker_config.errors import MessageError, OwnerFailed, Refused
from broker_config.keys import Kind
from broker_config.liveliness import runs_on
from broker_config.messages import (
    Attach,
    Control,
    DiscriminatorSnapshot,
    Heartbeat,
    JournalRequest,
    Metrics,
    Rewards,
    Snapshot,
    SnapshotRequest,
    TicketRequest,
    Trajectory,
    View,
    Welcome,
)
from broker_config.session import open_session
from broker_config.specs import NetworkSpec
from tests.conftest import until_declared

GARBAGE = [
    b"",
    b"\x00",
    b"\xc1" * 50,
    b"not msgpack at all",
    bytes([0x93, SCHEMA_VERSION]) + b"\xa6Ticket\x80",
]


def make_snapshot(version, size=1000, owner_epoch=1):
    weights = bytes([version % 256]) * size
    spec = NetworkSpec((84, 84, 3), 36, "plain", 1.0)
    return Snapshot(version, owner_epoch, spec, weights, hashlib.sha256(weights).hexdigest())


def test_a_late_joiner_gets_the_newest_snapshot_of_7_mb(attach):
    publisher_bus = attach("owner", "learner")
    publisher = publisher_bus.latest_publisher(publisher_bus.keys.policy)
    for version in range(3):
        publisher.put(make_snapshot(version, size=7_000_000))
    late = attach("actor", "late")
    reader = late.latest_reader(late.keys.policy, Snapshot)
    newest = reader.wait(20, lambda snapshot: snapshot.version == 2)
    assert newest == make_snapshot(2, size=7_000_000)
    assert reader.get() is newest


def test_a_reader_from_before_the_publisher_gets_each_newest_one(attach):
    early = attach("actor", "early")
    reader = early.latest_reader(early.keys.policy, Snapshot)
    assert reader.get() is None
    assert reader.wait(0.01) is None
    owner = attach("owner", "learner")
    publisher = owner.latest_publisher(owner.keys.policy)
    for version in range(20):
        publisher.put(make_snapshot(version))
    assert reader.wait(20, lambda snapshot: snapshot.version == 19) is not None


def test_closing_the_bus_wakes_whoever_waits_for_a_snapshot(attach):
    bus = attach("actor", "a")
    reader = bus.latest_reader(bus.keys.policy, Snapshot)
    result = []
    waiter = threading.Thread(target=lambda: result.append(reader.wait(100)))
    waiter.start()
    bus.close()
    waiter.join(20)
    assert result == [None]


STOPPABLE_READER = """
import sys, threading
from broker_config.bus import open_bus
from broker_config.keys import Kind
from broker_config.messages import Metrics
with open_bus(sys.argv[1], sys.argv[2], "observer", "stopped") as bus:
    bus.subscribe(bus.keys.every(Kind.METRICS), Metrics, lambda key, message: None)
    bus.declare_alive()
    threading.Event().wait()
"""


def test_a_stopped_viewer_delays_nobody(router, run_name, attach, wait_until):
    viewer = subprocess.Popen([sys.executable, "-c", STOPPABLE_READER, router.address, run_name])
    try:
        actor, healthy = attach("actor", "a"), attach("observer", "healthy")
        steps = []
        healthy.subscribe(
            healthy.keys.every(Kind.METRICS), Metrics, lambda _, message: steps.append(message.step)
        )
        wait_until(lambda: actor.alive(), "the viewer is attached")
        viewer.send_signal(signal.SIGSTOP)
        publisher = actor.publisher(actor.keys.metrics("actor", "a"))
        numbers = {f"{index:03}-{'x' * 200}": 0.0 for index in range(250)}  # 50 KB
        started = time.monotonic()
        for step in range(400):  # 20 MB: far more than the stopped viewer's buffers hold
            publisher.put(Metrics("actor", "a", "inc-1", step, step, numbers))

        def newest_arrives():
            publisher.put(Metrics("actor", "a", "inc-1", 400, 400, {}))
            return steps and steps[-1] == 400

        wait_until(newest_arrives, "the healthy reader has the newest message")
        # Measured 0.3 s; with BLOCK, everybody waits 5 s until the router cuts the viewer off.
        assert time.monotonic() - started < 4.9
    finally:
        viewer.kill()
        viewer.wait()


def test_alive_processes_are_listed_and_watched(attach, router, wait_until):
    observer = attach("observer", "console")
    events = []
    owner = attach("owner", "learner")
    owner.declare_alive()
    wait_until(lambda: len(observer.alive()) == 1, "the owner is listed")
    observer.watch_alive(lambda key, is_alive: events.append((key.role, key.id, is_alive)))
    wait_until(lambda: events == [("owner", "learner", True)], "the owner is reported")
    with open_session("client", router.address) as session:
        assert owner.keys.run in runs_on(session)
    owner.close()
    wait_until(lambda: events[1:] == [("owner", "learner", False)], "its end is reported")
    assert observer.alive() == []


def test_heartbeats_travel_on_the_key_of_the_token(attach, wait_until):
    owner, actor = attach("owner", "learner"), attach("actor", "a")
    seen = []
    owner.subscribe(owner.keys.every(Kind.LIVE), Heartbeat, lambda key, beat: seen.append(beat))
    actor.declare_alive()
    beat = Heartbeat("actor", "a", "inc-1", "host", 1, "collecting", 0.0, {"spooled": 0.0})
    publisher = actor.publisher(actor.keys.live("actor", "a"))

    def beat_arrives():
        publisher.put(beat)
        return seen

    wait_until(beat_arrives, "a heartbeat arrives")
    assert seen[0] == beat


def test_a_publisher_keeps_to_the_contract(attach):
    bus = attach("actor", "a")
    with pytest.raises(MessageError, match="expected a message of the contract; got Control"):
        bus.publisher(bus.keys.metrics("actor", "a")).put(Control(command="stop"))
    with pytest.raises(MessageError, match="expected a key for best effort"):
        bus.publisher(bus.keys.policy)
    with pytest.raises(MessageError, match="expected a key for latest; got one for query"):
        bus.latest_publisher(bus.keys.control)


SERVED = {
    Kind.ATTACH: Attach,
    Kind.TICKET: TicketRequest,
    Kind.TRAJECTORY: Trajectory,
    Kind.JOURNAL: JournalRequest,
    Kind.POLICY_VERSION: SnapshotRequest,
    Kind.CONTROL: Control,
    Kind.REWARDS: Rewards,
}


def keys_of(bus):
    keys = bus.keys
    return {
        Kind.ATTACH: keys.attach("actor", "a"),
        Kind.TICKET: keys.ticket("a"),
        Kind.TRAJECTORY: keys.trajectory("a"),
        Kind.JOURNAL: keys.journal("recorder", "recorder"),
        Kind.VIEW: keys.view("actor-1"),
        Kind.POLICY: keys.policy,
        Kind.POLICY_VERSION: keys.policy_version(3),
        Kind.METRICS: keys.metrics("actor", "a"),
        Kind.LIVE: keys.live("actor", "a"),
        Kind.CONTROL: keys.control,
        Kind.REWARDS: keys.rewards("discriminator"),
        Kind.DISCRIMINATORS: keys.discriminators,
    }


def test_garbage_on_every_key_is_counted_and_nothing_dies(router, attach, wait_until):
    owner = attach("owner", "learner")

    def never(*_):
        raise AssertionError("garbage was handed on")

    for kind, request_type in SERVED.items():
        owner.serve(owner.keys.every(kind), request_type, never)
    owner.subscribe(owner.keys.every(Kind.METRICS), Metrics, never)
    owner.subscribe(owner.keys.every(Kind.LIVE), Heartbeat, never)
    owner.subscribe(owner.keys.every(Kind.VIEW), View, never)
    reader = owner.latest_reader(owner.keys.policy, Snapshot)
    newest = owner.latest_reader(owner.keys.discriminators, DiscriminatorSnapshot)
    until_declared(owner)
    keys = keys_of(owner)
    assert set(keys) == set(Kind)

    with open_session("client", router.address) as foreign:
        for payload in GARBAGE:
            for kind, key in keys.items():
                if kind in SERVED:
                    replies = list(foreign.get(key, payload=payload, timeout=20))
                    assert len(replies) == 1
                    assert replies[0].ok is not None  # a refusal: the sender learns why
                else:
                    foreign.put(key, payload)
                    # One at a time: the readers keep few, and drop the rest by intention.
                    expected = GARBAGE.index(payload) + 1
                    wait_until(
                        lambda key=key, n=expected: (
                            owner.rejected.counts.get((key, "DecodeError")) == n
                        ),
                        f"garbage on {key} is counted",
                    )
        wait_until(
            lambda: (
                owner.rejected.counts
                == {(key, "DecodeError"): len(GARBAGE) for key in keys.values()}
            ),
            "all garbage is counted",
        )
    assert reader.get() is None
    assert newest.get() is None
    assert_still_works(owner, attach)


def assert_still_works(owner, attach):
    actor = attach("actor", "a")
    with pytest.raises(OwnerFailed, match="garbage was handed on"):  # the handler is reached
        actor.ask(
            actor.keys.attach("actor", "a"),
            Attach("actor", "a", "i", 1, "0", ""),
            Welcome,
            timeout_secs=20,
        )
    with pytest.raises(Refused, match="expected the sender of its key"):
        actor.ask(actor.keys.ticket("a"), TicketRequest("b", "i", "n"), Welcome, timeout_secs=20)


def test_a_question_under_a_key_that_is_none_is_answered_with_an_error(router, attach):
    owner = attach("owner", "learner")
    owner.serve(owner.keys.every(Kind.POLICY_VERSION), SnapshotRequest, lambda *_: None)
    until_declared(owner)
    with open_session("client", router.address) as foreign:
        replies = list(foreign.get(f"{owner.keys.policy}/newest", payload=b"", timeout=20))
    assert b"key's version" in replies[0].err.payload.to_bytes()


def test_a_message_beyond_its_size_limit_is_refused(router, attach):
    owner = attach("owner", "learner")
    owner.serve(owner.keys.control, Control, lambda *_: None)
    until_declared(owner)
    with open_session("client", router.address) as foreign:
        replies = foreign.get(
            owner.keys.control, payload=bytes(1 << 20), timeout=20, target=zenoh.QueryTarget.ALL
        )
        assert b"at most 4096 bytes" in next(iter(replies)).ok.payload.to_bytes()
