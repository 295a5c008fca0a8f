"""Malformed messages on every key of a run: nobody dies, and each is counted where it was heard.

How many: 3,000, or as the variable says: CLOTHBUS_MALFORMED=100000 pytest THIS_FILE
"""

from __future__ import annotations

import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from broker_config.bus import Bus, open_bus
from broker_config.codec import decode
from broker_config.contract import CONTRACT, Delivery
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import Heartbeat, Refusal, Role
from broker_config.session import open_session
from tests.malformed import forged_key, malformed
from tests.process.conftest import (
    Command,
    Start,
    trajectories,
    wait_for_file,
    wait_for_trajectories,
)

TOTAL = int(os.environ.get("CLOTHBUS_MALFORMED", "3000"))
RUN = "run"
ROUTER_LIMIT_BYTES = 16 << 20

QUESTIONS = [row.kind for row in CONTRACT if row.delivery is Delivery.QUERY]
MESSAGES: dict[Kind, Role] = {Kind.LIVE: "owner", Kind.VIEW: "recorder", Kind.METRICS: "recorder"}
"""Who hears the best-effort messages of a kind, all of them if they are sent slowly enough."""
PER_MESSAGE_KIND = 250
LEFT_WAITING = 32
"""Messages on their way to one reader; it drops some from 64 on."""
WINDOW = 64
"""Questions on their way."""
COUNTED_SECS = 60.0
BLOCK = zenoh.CongestionControl.BLOCK
"""Sent like this, none is dropped on the way on a busy machine."""


class Rejects:
    """How many messages each process says that it has rejected."""

    def __init__(self, bus: Bus, wait_until: Callable[..., None]) -> None:
        self._by_role: dict[Role, float] = {}
        self._lock = threading.Lock()
        self._wait_until = wait_until
        self.expected: Counter[Role] = Counter()
        bus.subscribe(bus.keys.every(Kind.LIVE), Heartbeat, self._on_heartbeat)

    def _on_heartbeat(self, _: ParsedKey, heartbeat: Heartbeat) -> None:
        with self._lock:
            self._by_role[heartbeat.role] = heartbeat.numbers["rejected"]

    def of(self, role: Role) -> float | None:
        with self._lock:
            return self._by_role.get(role)

    def wait_for_expected(self, role: Role) -> None:
        """Waits until exactly what was expected is counted."""

        def what() -> str:
            return f"{role} has rejected {self.expected[role]}; it says {self.of(role)}"

        try:
            self._wait_until(
                lambda: self.of(role) == self.expected[role], "all counted", COUNTED_SECS
            )
        except AssertionError as error:
            raise AssertionError(what()) from error


@pytest.fixture
def run(start: Start, tmp_path: Path) -> Iterator[tuple[str, dict[str, Command]]]:
    """A run of each kind of process; they must all live at the end."""
    limit = f"transport/link/rx/max_message_size={ROUTER_LIMIT_BYTES}"
    router = start("router", "router", "--address-file", tmp_path / "address", "--zenoh", limit)
    address = wait_for_file(tmp_path / "address", router)
    of_run = ["--run", RUN, "--connect", address]
    processes = {
        "router": router,
        "learner": start(
            "learner", "learner", tmp_path / RUN, "--preset", "reaching-smoke",
            "--connect", address, "--set", "schedule.iterations=100000",
        ),
        "actor": start("actor", "actor", "--id", "actor", "--spool", tmp_path / "spool", *of_run),
        "recorder": start("recorder", "record", "--output", tmp_path / RUN, *of_run),
        "evaluator": start(
            "evaluator", "evaluator", "--id", "evaluator", "--output", tmp_path / RUN,
            "--episodes", 1, *of_run,
        ),
    }  # fmt: skip
    wait_for_trajectories(tmp_path / RUN, 1)
    yield address, processes
    wait_for_trajectories(tmp_path / RUN, trajectories(tmp_path / RUN) + 2)
    for name, command in processes.items():
        assert command.process.poll() is None, f"{name} died: {command.log.read_text()[-3000:]}"


@pytest.mark.timeout(1200)
def test_no_malformed_message_ends_a_process_and_each_is_counted(
    run: tuple[str, dict[str, Command]], wait_until: Callable[..., None]
) -> None:
    address, processes = run
    questions = TOTAL - PER_MESSAGE_KIND * len(MESSAGES)
    with (
        open_bus(address, RUN, "observer", "test") as bus,
        open_session("client", address) as session,
    ):
        rejects = Rejects(bus, wait_until)
        for role in ("owner", "actor", "recorder", "evaluator"):
            wait_until(lambda role=role: rejects.of(role) == 0, f"{role} is there", 60)
        for number, kind in enumerate(QUESTIONS):
            share = questions // len(QUESTIONS) + (number < questions % len(QUESTIONS))
            _ask_all(session, kind, share)
            rejects.expected["owner"] += share
        rejects.wait_for_expected("owner")
        for kind, role in MESSAGES.items():
            _send_all(session, kind, role, rejects)
        _send_to_everybody(session, rejects)
        _send_policies(session, rejects, wait_until)
        _send_what_is_larger_than_the_router_allows(address, rejects)
        _expect_names_in_logs(processes)


def _ask_all(session: zenoh.Session, kind: Kind, count: int) -> None:
    """Each must be answered, and by a refusal."""
    key = forged_key(RUN, kind)
    pending: deque[zenoh.Handler[zenoh.Reply]] = deque()
    for item in malformed(RUN, kind, count, seed=3):
        channel = zenoh.handlers.FifoChannel(2)
        pending.append(session.get(key, channel, payload=item.payload, timeout=60))
        if len(pending) == WINDOW:
            _expect_refusal(key, pending.popleft())
    while pending:
        _expect_refusal(key, pending.popleft())


def _expect_refusal(key: str, replies: zenoh.Handler[zenoh.Reply]) -> None:
    (reply,) = list(replies)
    assert reply.ok is not None, f"{key}: {reply.err and reply.err.payload.to_bytes()!r}"
    assert isinstance(decode(reply.ok.payload.to_bytes(), Refusal), Refusal)


def _send_all(session: zenoh.Session, kind: Kind, role: Role, rejects: Rejects) -> None:
    key, bad = forged_key(RUN, kind), malformed(RUN, kind, PER_MESSAGE_KIND, seed=4)
    for number in range(0, len(bad), LEFT_WAITING):
        batch = bad[number : number + LEFT_WAITING]
        for item in batch:
            session.put(key, item.payload, congestion_control=BLOCK)
        rejects.expected[role] += len(batch)
        rejects.wait_for_expected(role)


def _send_to_everybody(session: zenoh.Session, rejects: Rejects) -> None:
    """Keys that are patterns, or match what somebody serves and are no keys of the contract."""
    for key in (f"{RUN}/ticket/Upper", f"{RUN}/attach/king/id", f"{RUN}/policy/007"):
        rejects.expected["owner"] += _errors(session, key)
    everything = _errors(session, f"{RUN}/**")
    assert everything == len(QUESTIONS), "each of the learner's servers has refused it"
    rejects.expected["owner"] += everything
    session.put(f"{RUN}/live/*/x", b"", congestion_control=BLOCK)
    session.put(f"{RUN}/live/king/id", b"", congestion_control=BLOCK)
    rejects.expected["owner"] += 2
    session.delete(forged_key(RUN, Kind.LIVE))
    rejects.expected["owner"] += 1
    rejects.wait_for_expected("owner")
    session.put(f"{RUN}/view/*", b"", congestion_control=BLOCK)
    session.put(f"{RUN}/metrics/actor/Upper", b"", congestion_control=BLOCK)
    rejects.expected["recorder"] += 2
    rejects.wait_for_expected("recorder")


def _errors(session: zenoh.Session, key: str) -> int:
    replies = list(session.get(key, payload=b"", timeout=30))
    assert all(reply.err is not None for reply in replies), key
    return len(replies)


def _send_policies(
    session: zenoh.Session, rejects: Rejects, wait_until: Callable[..., None]
) -> None:
    """Who reads policies keeps the newest only, and the learner publishes too: some are missed."""
    for item in malformed(RUN, Kind.POLICY, 150, seed=5)[::15]:
        before = rejects.of("actor"), rejects.of("evaluator")

        def both_count_more(before=before) -> bool:
            now = rejects.of("actor"), rejects.of("evaluator")
            return all(new > old for new, old in zip(now, before, strict=True))

        def send_again(item=item, both_count_more=both_count_more) -> bool:
            session.put(f"{RUN}/policy", item.payload)
            return both_count_more()

        wait_until(send_again, "actor and evaluator count a policy that is none", COUNTED_SECS)


def _send_what_is_larger_than_the_router_allows(address: str, rejects: Rejects) -> None:
    with open_session("client", address) as session:
        replies = session.get(
            forged_key(RUN, Kind.TRAJECTORY), payload=bytes(ROUTER_LIMIT_BYTES + 1), timeout=5
        )
        assert all(reply.ok is None for reply in replies)
    rejects.wait_for_expected("owner")  # it never got there


def _expect_names_in_logs(processes: dict[str, Command]) -> None:
    """The first of each key and kind of reason is in the log of whoever has counted it."""
    heard: dict[str, list[Kind]] = {
        "learner": [*QUESTIONS, Kind.LIVE],
        "recorder": [Kind.VIEW, Kind.METRICS],
        "actor": [Kind.POLICY],
        "evaluator": [Kind.POLICY],
    }
    for process, kinds in heard.items():
        said = " ".join(processes[process].log.read_text().split())
        for kind in kinds:
            assert f"dropped a message on {forged_key(RUN, kind)}" in said, (process, kind)
