"""Acked trajectories per second through a router: a window of one beside the window in use.

    make bench

650 KB each, committed to a journal before the ack. Prints a ratio.
"""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path

from actors.delivery import WINDOW
from broker_config.bus import Bus
from broker_config.codec import encode
from broker_config.journal import Journal
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import Ack, Trajectory, Verdict
from broker_config.queries import PendingReply, Responder

COUNT = 60
ROUNDS = 3


def serve(bus: Bus, journal: Journal) -> None:
    def take(_: ParsedKey, trajectory: Trajectory, to: Responder) -> None:
        future = journal.append([(str(trajectory.id), encode(trajectory))])
        ack = Ack(trajectory.id, 1, 0, Verdict.ACCEPTED, duplicate=False)
        future.add_done_callback(lambda _: to.reply(ack))

    bus.serve(bus.keys.every(Kind.TRAJECTORY), Trajectory, take)


def acked_per_sec(bus: Bus, payloads: list[bytes], window: int) -> float:
    key = bus.keys.trajectory("actor-01")
    pending: deque[PendingReply[Ack]] = deque()
    began_secs = time.monotonic()
    for payload in payloads:
        pending.append(bus.ask_later(key, payload, Ack, timeout_secs=10))
        if len(pending) == window:
            pending.popleft().result()
    while pending:
        pending.popleft().result()
    return len(payloads) / (time.monotonic() - began_secs)


def test_a_window_beside_one_at_a_time(attach, make_trajectory, tmp_path: Path) -> None:
    owner, actor = attach("owner", "owner"), attach("actor", "actor-01")
    with Journal(tmp_path / "journal.sqlite") as journal:
        serve(owner, journal)
        sequence = iter(range(10**6))
        ratios = []
        for _ in range(ROUNDS):
            rates = []
            for window in (1, WINDOW):
                payloads = [encode(make_trajectory(next(sequence), steps=30)) for _ in range(COUNT)]
                rates.append(acked_per_sec(actor, payloads, window))
            ratios.append(rates[1] / rates[0])
            print(f"window 1: {rates[0]:.0f}/s, window {WINDOW}: {rates[1]:.0f}/s")
        print(f"window {WINDOW} / window 1: median {sorted(ratios)[ROUNDS // 2]:.2f} of {ROUNDS}")
        owner.close()  # before the journal that its handler writes to
