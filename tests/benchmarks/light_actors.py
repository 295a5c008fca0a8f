"""A hundred actors that cost nothing but their messages, at one learner: ingest and memory.

    python -m tests.benchmarks.light_actors --secs 600

Each actor has a session, a spool and a delivery of its own; it asks for tickets, waits for exactly
the policy version of each and delivers 21 KB of random pictures. Nothing is simulated and no
network is evaluated. A few processes hold the actors; their spools lie in memory, since a hundred
real actors would not share one disk. Router, learner and journal are those of every run; the
learner updates rarely. In the end every acknowledged trajectory must be in the journal once.
"""

from __future__ import annotations

import argparse
import json
import secrets
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import TypeVar

import numpy as np

from actors.delivery import Delivery, wait_until
from broker_config.bus import Bus, open_bus
from broker_config.codec import SCHEMA_VERSION, decode
from broker_config.errors import OwnerUnreachable
from broker_config.heart import Heart, Pulse
from broker_config.journal import JOURNAL_FILE, JournalReader
from broker_config.messages import (
    Attach,
    AttemptEnded,
    Instruction,
    Snapshot,
    SnapshotRequest,
    Ticket,
    TicketReply,
    TicketRequest,
    Trajectory,
    TrajectoryId,
    Verdict,
    Welcome,
)
from broker_config.spool import Spool
from broker_config.version import VERSION
from tests.benchmarks.measuring import (
    RESULTS,
    MemorySampler,
    Processes,
    Started,
    cpu_secs_of,
    keep_result,
    percentile,
)

RUN = "load"
START_FILE = "start"
JOIN_SECS = 180.0
STEPS = 2
PICTURE = (84, 84, 1)
"""Three of them are 21 KB."""
Reply = TypeVar("Reply")
SPOOL_BYTES = 4 << 20
ANSWER_SECS = 120.0
RETRY_SECS = 0.5
FLUSH_SECS = 60.0
"""How long what is left may take at the end."""
WARM_UP_SHARE = 0.2
"""Of the time; memory is compared with what it was at the end of it."""
GROWTH_BOUND_MIB = 100.0
STEADY_SECS = 300.0
"""The first update alone takes more memory than the bound, and comes after 5,000 trajectories."""
SETTINGS = (
    f"task.horizon={STEPS}",
    "schedule.iterations=100000",
    "schedule.update_every=iteration",
    "schedule.episodes_per_iteration=5000",
    "schedule.policy_lag=1",
    "schedule.memory_samples=64",
    "schedule.target_switches=1",
    "schedule.epochs=1",
    "schedule.minibatch_size=32",
)


class LightActor:
    """Asks, waits for the policy, delivers; on a thread of its own."""

    def __init__(self, address: str, name: str, spools: Path, rate: float) -> None:
        self.name = name
        self.sent = 0
        self.failure: str | None = None
        self._address = address
        self._spools = spools
        self._pause_secs = 1 / rate if rate else 0.0
        self._incarnation = secrets.token_hex(8)
        self._pulse = Pulse()
        self._pictures = np.random.default_rng().integers(0, 256, (STEPS + 1, *PICTURE), np.uint8)
        self._fetched = -1

    def run(self, ready: threading.Barrier, secs: float) -> None:
        """As `_act`; notes why it could not go on."""
        try:
            self._act(ready, secs)
        except Exception:
            self.failure = traceback.format_exc()
            ready.abort()

    def _act(self, ready: threading.Barrier, secs: float) -> None:
        """Joins, waits for the others, acts for a while and delivers what is left."""
        spool = Spool(self._spools / f"{self.name}.sqlite", RUN, self.name, self._incarnation,
                      SPOOL_BYTES)  # fmt: skip
        with open_bus(self._address, RUN, "actor", self.name) as bus, spool:
            epoch = self._attach(bus).owner_epoch
            vitals = ("acting", dict[str, float]())
            heart = Heart(bus, "actor", self.name, self._incarnation, lambda: vitals, self._pulse)
            policies = bus.latest_reader(bus.keys.policy, Snapshot)
            key = bus.keys.trajectory(self.name)
            with heart, Delivery(bus, spool, key, lambda: epoch) as delivery:
                policies.wait(60)
                ready.wait()
                until_secs = time.monotonic() + secs
                while time.monotonic() < until_secs:
                    self._pulse.beat()
                    began_secs = time.monotonic()
                    if (ticket := self._next_ticket(bus)) is not None:
                        self._fetch(bus, ticket, policies.get())
                        spool.put(self._play(spool.next_id(), ticket))
                        self.sent += 1
                        delivery.notify()
                    time.sleep(max(0.0, began_secs + self._pause_secs - time.monotonic()))
                flushed = delivery.flush(wait_until(time.monotonic() + FLUSH_SECS))
                assert flushed, f"{self.name}: {spool.status()} was not acked in {FLUSH_SECS} s"

    def _attach(self, bus: Bus) -> Welcome:
        request = Attach("actor", self.name, self._incarnation, SCHEMA_VERSION, VERSION, "")
        return _ask(bus, bus.keys.attach("actor", self.name), request, Welcome)

    def _next_ticket(self, bus: Bus) -> Ticket | None:
        request = TicketRequest(self.name, self._incarnation, secrets.token_hex(8))
        reply = _ask(bus, bus.keys.ticket(self.name), request, TicketReply)
        assert reply.instruction in (Instruction.COLLECT, Instruction.WAIT), reply
        return reply.ticket

    def _fetch(self, bus: Bus, ticket: Ticket, newest: Snapshot | None) -> None:
        version = ticket.policy_version
        if version != self._fetched and (newest is None or newest.version != version):
            _ask(bus, bus.keys.policy_version(version), SnapshotRequest(version), Snapshot)
        self._fetched = version

    def _play(self, id_: TrajectoryId, ticket: Ticket) -> Trajectory:
        return Trajectory(
            id=id_,
            ticket=ticket,
            observations=self._pictures,
            actions=np.zeros(STEPS, np.int32),
            rewards=np.zeros(STEPS, np.float32),
            terminated=False,
            truncated=True,
            success=False,
            guard=None,
            interrupted=False,
            ended_unix_secs=time.time(),
        )


def _ask(bus: Bus, key: str, request: object, expected: type[Reply]) -> Reply:
    """Asks as actors do: the same question again, after a pause, until there is an answer."""
    deadline_secs = time.monotonic() + ANSWER_SECS
    while True:
        try:
            return bus.ask(key, request, expected, timeout_secs=30)
        except OwnerUnreachable:
            if time.monotonic() > deadline_secs:
                raise
            time.sleep(RETRY_SECS)


def act(arguments: argparse.Namespace) -> None:
    """One process with a share of the actors; writes what each has sent."""
    ready = threading.Barrier(arguments.actors, lambda: _wait_for_start(arguments.report))
    actors = [
        LightActor(arguments.address, f"light-{number:03d}", arguments.spools, arguments.rate)
        for number in range(arguments.first, arguments.first + arguments.actors)
    ]
    threads = [threading.Thread(target=it.run, args=[ready, arguments.secs]) for it in actors]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures := [it.failure for it in actors if it.failure is not None]:
        sys.exit(f"{len(failures)} of {len(actors)} actors failed; the first:\n{failures[0]}")
    arguments.report.write_text(json.dumps({it.name: it.sent for it in actors}))


def _wait_for_start(report: Path) -> None:
    """Tells that this process's actors have joined, and waits for those of the others."""
    report.with_suffix(".ready").touch()
    while not report.with_name(START_FILE).exists():
        time.sleep(0.01)


def start_actors(
    processes: Processes, address: str, arguments: argparse.Namespace, folder: Path, spools: Path
) -> list[Started]:
    """Starts the processes that hold the actors; returns when all have joined and begin."""
    share = arguments.actors // arguments.processes
    started = [
        processes.start(
            f"actors-{number}", "-m", "tests.benchmarks.light_actors", "--address", address,
            "--first", number * share, "--actors", share, "--secs", arguments.secs,
            "--rate", arguments.rate, "--spools", spools,
            "--report", folder / f"sent-{number}.json",
        )
        for number in range(arguments.processes)
    ]  # fmt: skip
    deadline_secs = time.monotonic() + JOIN_SECS
    while len(list(folder.glob("sent-*.ready"))) < arguments.processes:
        assert time.monotonic() < deadline_secs, f"not all joined in {JOIN_SECS} s"
        time.sleep(0.02)
    (folder / START_FILE).touch()
    return started


def measure(arguments: argparse.Namespace) -> dict[str, object]:
    """The whole benchmark."""
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
    with (
        tempfile.TemporaryDirectory(dir=arguments.folder) as name,
        tempfile.TemporaryDirectory(dir=memory) as spools,
        Processes(Path(name)) as processes,
    ):
        folder = Path(name)
        router, address = processes.router()
        learner = processes.clothbus(
            "learner", "learner", folder / RUN, "--preset", "reaching-smoke",
            "--connect", address, "--set", *SETTINGS,
        )  # fmt: skip
        wait_for_learner(address, learner)
        watched = {"learner": learner, "router": router}
        trace = arguments.out.with_suffix(".memory.jsonl")
        trace.parent.mkdir(parents=True, exist_ok=True)
        actors = start_actors(processes, address, arguments, folder, Path(spools))
        began_secs = time.monotonic()
        with MemorySampler(trace, watched) as memory_of, cpu_secs_of(watched) as cpu_secs:
            for started in actors:
                started.wait(arguments.secs + 180)
        took_secs = time.monotonic() - began_secs
        learner.close()
        sent = Counter[str]()
        for report in folder.glob("sent-*.json"):
            sent.update(json.loads(report.read_text()))
        stored, spare, payload_bytes = _stored(folder / RUN / JOURNAL_FILE)
        wrong = {name: (sent[name], stored[name]) for name in sent | stored}
        wrong = {name: counts for name, counts in wrong.items() if counts[0] != counts[1]}
        assert not wrong, f"sent, and found in the journal: {wrong}"
        count = sent.total()
        return {
            "actors": arguments.actors,
            "secs": round(took_secs, 1),
            "trajectories": count,
            "spare": spare,
            "bytes_each": payload_bytes // count,
            "trajectories_per_sec": round(count / took_secs, 1),
            "mb_per_sec": round(payload_bytes / took_secs / 1e6, 2),
            "cpu_share": {name: round(it / took_secs, 2) for name, it in cpu_secs.items()},
            "memory": {name: memory_figures(values) for name, values in memory_of.mib.items()},
        }


def wait_for_learner(address: str, learner: Started) -> None:
    """Waits until the run is there."""
    with open_bus(address, RUN, "observer", "load") as bus:
        deadline_secs = time.monotonic() + 60
        while not any(key.role == "owner" for key in bus.alive()):
            assert learner.process.poll() is None, learner.said()
            assert time.monotonic() < deadline_secs, "no learner"
            time.sleep(0.1)


def _stored(journal: Path) -> tuple[Counter[str], int, int]:
    """Trajectories by actor (each name is there once), how many were spare, and their bytes."""
    by_actor, spare, payload_bytes = Counter[str](), 0, 0
    accepted = set()
    with JournalReader(journal) as reader:
        for entry in reader:
            if entry.name.startswith("trajectory/"):
                payload_bytes += len(entry.payload)
            elif entry.name.startswith("ended/"):
                ended = decode(entry.payload, AttemptEnded)
                assert ended.trajectory is not None
                by_actor[ended.trajectory.actor] += 1
                if ended.verdict is Verdict.SPARE:  # an actor seemed silent, and its lease was over
                    spare += 1
                    continue
                assert ended.verdict is Verdict.ACCEPTED, ended
                assert ended.ticket not in accepted, "a ticket counted twice"
                accepted.add(ended.ticket)
    return by_actor, spare, payload_bytes


def memory_figures(mib: list[float]) -> dict[str, float]:
    """How memory went on after the warm-up, in MiB: medians of the first and the last tenth."""
    steady = mib[int(len(mib) * WARM_UP_SHARE) :]
    tenth = max(1, len(steady) // 10)
    begin, end = percentile(steady[:tenth], 0.5), percentile(steady[-tenth:], 0.5)
    return {"begin": begin, "end": end, "growth": round(end - begin, 1), "most": max(mib)}


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--secs", type=float, default=600.0)
    parser.add_argument("--actors", type=int, default=100)
    parser.add_argument("--processes", type=int, default=4)
    parser.add_argument("--rate", type=float, default=0.0, help="of each actor; 0 is no limit")
    parser.add_argument("--folder", type=Path, help="for run folder and journal; default: /tmp")
    parser.add_argument("--out", type=Path, default=RESULTS)
    inside = parser.add_argument_group("of a process that holds actors")
    inside.add_argument("--address", help=argparse.SUPPRESS)
    inside.add_argument("--first", type=int, help=argparse.SUPPRESS)
    inside.add_argument("--spools", type=Path, help=argparse.SUPPRESS)
    inside.add_argument("--report", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    arguments = parse_arguments()
    if arguments.address:
        act(arguments)
        return
    result = measure(arguments)
    keep_result(arguments.out, "light_actors", result)
    if arguments.secs < STEADY_SECS:
        print(f"less than {STEADY_SECS:.0f} s are all warm-up: the bound is not held against them")
        return
    for name, figures in result["memory"].items():
        assert figures["growth"] <= GROWTH_BOUND_MIB, f"{name} grew by {figures['growth']} MiB"


if __name__ == "__main__":
    main()
