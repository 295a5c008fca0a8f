"""Delivery of 650 KB episodes, stored and acknowledged, beside carrying the same bytes only.

    python -m tests.benchmarks.delivery_load --episodes 1000

* clothbus: two actor processes, a router, and a process that takes episodes as the learner does
  (`Owner.receive`: checked, judged, committed with fsync, then acked) and publishes a 7 MB policy
  after every tenth episode. The actors' spools and the journal lie on the disk.
* ray: two actors that call a third one with the bytes, a window of calls each.
* grpc: unary calls with the bytes from two processes to a third, a window each.

Ray and gRPC store nothing, judge nothing and survive no accident: they show what carrying costs.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import secrets
import tempfile
import threading
import time
from concurrent import futures
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from actors.delivery import WINDOW, Delivery, wait_until
from broker_config.bus import Bus, open_bus
from broker_config.errors import OwnerUnreachable
from broker_config.heart import Heart, Pulse
from broker_config.journal import Journal
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import (
    Ack,
    Snapshot,
    SnapshotTaken,
    Ticket,
    TicketReply,
    TicketRequest,
    Trajectory,
    TrajectoryId,
    weights_digest,
)
from broker_config.queries import Responder
from broker_config.spool import Spool
from deploy.presets import load_preset
from learner.owner import Owner
from learner.ticket_desk import TicketDesk
from tests.benchmarks.carriers import (
    measure_grpc,
    measure_ray,
    run_grpc_client,
    run_grpc_server,
)
from tests.benchmarks.counting_relay import CountingRelay
from tests.benchmarks.episodes import ACTORS, STEPS, episode_bytes, make_episode
from tests.benchmarks.measuring import (
    RESULTS,
    Processes,
    Started,
    keep_result,
    percentile,
    wait_for_file,
    wait_for_sign,
)

RUN = "delivery"
WEIGHTS_BYTES = 7_000_000
EPISODES_PER_POLICY = 10
SPOOL_BYTES = 1 << 30
END_SECS = 540.0
EPISODES_COUNTED = 20
SETTINGS = [
    f"task.horizon={STEPS}",
    "schedule.update_every=iteration",
    f"schedule.episodes_per_iteration={EPISODES_PER_POLICY}",
    # Nobody waits for a policy: what is measured is delivery, and how old the policy is meanwhile.
    "schedule.policy_lag=1000000",
]


# clothbus: the owner -----------------------------------------------------------------------------


class Receiver:
    """An owner that learns nothing: its policies are random bytes, and known by their version."""

    def __init__(self, bus: Bus, owner: Owner, desk: TicketDesk, episodes: int) -> None:
        self._owner = owner
        self._episodes = episodes
        self._received = 0
        self._lock = threading.Lock()
        self._due = threading.Semaphore(1)
        self.is_complete = threading.Event()
        self.published_secs: dict[int, float] = {}
        self._policies = bus.latest_publisher(bus.keys.policy)
        bus.serve(bus.keys.every(Kind.TRAJECTORY), Trajectory, self._on_trajectory)
        bus.serve(
            bus.keys.every(Kind.TICKET),
            TicketRequest,
            lambda _, request, to: desk.ask(request, to.reply),
        )

    def _on_trajectory(self, _: ParsedKey, trajectory: Trajectory, to: Responder) -> None:
        def answer(ack: futures.Future[Ack]) -> None:
            to.reply(ack.result())
            with self._lock:
                self._received += 1
                if self._received % EPISODES_PER_POLICY == 0:
                    self._due.release()
                if self._received == self._episodes:
                    self.is_complete.set()
                    self._due.release()

        self._owner.receive(trajectory, to.question).add_done_callback(answer)

    def publish_until_complete(self) -> None:
        """Publishes a policy whenever one is due."""
        weights = np.random.default_rng(0).bytes(WEIGHTS_BYTES)
        for version in range(10**6):
            self._due.acquire()
            if self.is_complete.is_set():
                return
            fresh = version.to_bytes(8, "little") + weights[8:]
            digest = weights_digest(fresh)
            spec = self._owner.preset.network
            snapshot = Snapshot(version, self._owner.epoch, spec, fresh, digest)
            self._owner.policy_ready(SnapshotTaken(version, digest, 0))
            self.published_secs[version] = time.monotonic()
            self._policies.put(snapshot)


def run_owner(arguments: argparse.Namespace) -> None:
    """The process that takes episodes."""
    episodes = f"schedule.iterations={arguments.episodes}"
    preset = load_preset("handkerchief-quickstart", [*SETTINGS, episodes])
    with (
        Journal(arguments.folder / "journal.sqlite") as journal,
        open_bus(arguments.address, RUN, "owner", "learner") as bus,
    ):
        owner = Owner(RUN, preset, journal)
        vitals = ("taking", dict[str, float]())
        with (
            TicketDesk(owner) as desk,
            Heart(bus, "owner", "learner", "epoch", lambda: vitals, Pulse()),
        ):
            receiver = Receiver(bus, owner, desk, arguments.episodes)
            receiver.publish_until_complete()
            report = {str(version): at for version, at in receiver.published_secs.items()}
            arguments.report.write_text(json.dumps(report))
            wait_for_file(arguments.folder / "end")
        bus.close()  # before the journal that its handlers write to


# clothbus: an actor ------------------------------------------------------------------------------


class TimedSpool(Spool):
    """Notes when an episode was handed over and when it was acknowledged."""

    put_secs: dict[TrajectoryId, float]
    acked_secs: dict[TrajectoryId, float]

    def put(self, trajectory: Trajectory) -> None:
        self.put_secs[trajectory.id] = time.monotonic()
        super().put(trajectory)

    def acknowledge(self, trajectory_id: TrajectoryId) -> bool:
        self.acked_secs[trajectory_id] = time.monotonic()
        return super().acknowledge(trajectory_id)


def run_actor(arguments: argparse.Namespace) -> None:
    """One actor: asks, takes the newest policy, and hands over episodes made before."""
    name, incarnation = arguments.name, secrets.token_hex(8)
    episodes = arguments.episodes // ACTORS
    made = [
        make_episode(number, Ticket(0, 0, 0, 0, 0, STEPS, 0.0), TrajectoryId(name, "b", 0))
        for number in range(20)
    ]
    path = arguments.folder / f"{name}.sqlite"
    acted: list[tuple[float, int]] = []
    with (
        TimedSpool(path, RUN, name, incarnation, SPOOL_BYTES) as spool,
        open_bus(arguments.address, RUN, "actor", name) as bus,
    ):
        spool.put_secs, spool.acked_secs = {}, {}
        policies = bus.latest_reader(bus.keys.policy, Snapshot)
        vitals = ("acting", dict[str, float]())
        assert policies.wait(60) is not None
        with (
            Heart(bus, "actor", name, incarnation, lambda: vitals, Pulse()),
            Delivery(bus, spool, bus.keys.trajectory(name), lambda: 0) as delivery,
        ):
            (arguments.folder / f"{name}.ready").touch()
            wait_for_file(arguments.folder / "start")
            for number in range(episodes):
                ticket = _ask_for_ticket(bus, name, incarnation)
                policy = policies.get()
                assert policy is not None
                acted.append((time.monotonic(), policy.version))
                spool.put(dataclasses.replace(made[number % 20], id=spool.next_id(), ticket=ticket))
                delivery.notify()
                delivery_room(spool)
            assert delivery.flush(wait_until(time.monotonic() + 120)), "not all was acked"
    latency = [spool.acked_secs[id_] - put for id_, put in spool.put_secs.items()]
    report = {"latency_secs": latency, "acted": acted, "last_secs": max(spool.acked_secs.values())}
    arguments.report.write_text(json.dumps(report))


def delivery_room(spool: Spool) -> None:
    """An actor that is far ahead would measure its own queue: at most a window waits."""
    while spool.status().trajectories >= WINDOW:
        time.sleep(0.001)


def _ask_for_ticket(bus: Bus, name: str, incarnation: str) -> Ticket:
    request = TicketRequest(name, incarnation, secrets.token_hex(8))
    while True:
        try:
            reply = bus.ask(bus.keys.ticket(name), request, TicketReply, timeout_secs=10)
        except OwnerUnreachable:
            time.sleep(0.1)
            continue
        if reply.ticket is not None:
            return reply.ticket


# clothbus: the measurement -----------------------------------------------------------------------


def measure_clothbus(episodes: int) -> dict[str, Any]:
    """Runs it; the bytes on the wire are counted in a short run of its own."""
    figures = _figures(episodes, _run_clothbus(episodes, counts_bytes=False))
    counted = _run_clothbus(EPISODES_COUNTED, counts_bytes=True)
    per_transition = counted.sent_bytes / EPISODES_COUNTED / STEPS
    return {**figures, "wire_bytes_per_transition": round(per_transition)}


@dataclass(frozen=True)
class Ran:
    """What is known of a run."""

    took_secs: float
    reports: list[dict[str, Any]]
    """Of the actors."""
    published_secs: dict[str, float]
    """When each policy was, by version."""
    sent_bytes: int
    """By the actors, acks and policies not counted; 0 where nobody counts."""


def _run_clothbus(episodes: int, *, counts_bytes: bool) -> Ran:
    with tempfile.TemporaryDirectory() as name, Processes(Path(name)) as processes:
        folder = Path(name)
        _, address = processes.router()
        relay = CountingRelay(address) if counts_bytes else None

        def start(part: str, who: str) -> Started:
            through = relay.address if relay and part == "actor" else address
            return processes.start(
                who, "-m", "tests.benchmarks.delivery_load", "--part", part, "--name", who,
                "--address", through, "--folder", folder, "--episodes", episodes,
                "--report", folder / f"{who}.json",
            )  # fmt: skip

        owner = start("owner", "owner")
        actors = [start("actor", f"actor-{number}") for number in range(ACTORS)]
        for number in range(ACTORS):
            wait_for_sign(folder / f"actor-{number}.ready", [owner, *actors])
        before_bytes = relay.sent_bytes if relay else 0
        began_secs = time.monotonic()
        (folder / "start").touch()
        for actor in actors:
            actor.wait(END_SECS)
        sent_bytes = relay.sent_bytes - before_bytes if relay else 0
        (folder / "end").touch()
        owner.wait(60)
        reports = [json.loads((folder / f"actor-{n}.json").read_text()) for n in range(ACTORS)]
        published = json.loads((folder / "owner.json").read_text())
        took_secs = max(it["last_secs"] for it in reports) - began_secs
    return Ran(took_secs, reports, published, sent_bytes)


def _figures(episodes: int, ran: Ran) -> dict[str, Any]:
    reports, published, took_secs = ran.reports, ran.published_secs, ran.took_secs
    latency = [secs for report in reports for secs in report["latency_secs"]]
    acted = [(at, version) for report in reports for at, version in report["acted"]]
    ages = [at - published[str(version)] for at, version in acted]
    first_uses = [
        at - published[version]
        for report in reports
        for version, at in _first_uses(report["acted"]).items()
    ]
    behind = [_newest_at(published, at) - version for at, version in acted]
    assert len(latency) == episodes
    assert first_uses, "no policy came in time: take more episodes"
    payload_bytes = len(episode_bytes())
    return {
        "episodes": episodes,
        "bytes_each": payload_bytes,
        "acked_per_sec": round(episodes / took_secs, 1),
        "mb_per_sec": round(episodes * payload_bytes / took_secs / 1e6, 1),
        "ms_to_ack_p50": round(1e3 * percentile(latency, 0.5), 1),
        "ms_to_ack_p99": round(1e3 * percentile(latency, 0.99), 1),
        "policies": len(published),
        "ms_to_first_action_on_a_policy_p50": round(1e3 * percentile(first_uses, 0.5), 1),
        "ms_to_first_action_on_a_policy_p99": round(1e3 * percentile(first_uses, 0.99), 1),
        "policy_age_ms_p50": round(1e3 * percentile(ages, 0.5), 1),
        "policy_age_ms_p99": round(1e3 * percentile(ages, 0.99), 1),
        "policy_versions_behind_p50": percentile(behind, 0.5),
        "policy_versions_behind_p99": percentile(behind, 0.99),
        "payload_bytes_per_transition": round(payload_bytes / STEPS),
    }


def _first_uses(acted: list[tuple[float, int]]) -> dict[str, float]:
    """When an actor began its first episode on each policy, but for what was there before it."""
    first: dict[str, float] = {}
    for at, version in acted:
        first.setdefault(str(version), at)
    first.pop(str(acted[0][1]))
    return first


def _newest_at(published: dict[str, float], at_secs: float) -> int:
    return max((int(version) for version, at in published.items() if at <= at_secs), default=0)


# The command -------------------------------------------------------------------------------------


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=3, help="each with every system in turn")
    parser.add_argument("--out", type=Path, default=RESULTS)
    inside = parser.add_argument_group("of one process")
    for name in ("--part", "--address", "--name"):
        inside.add_argument(name, help=argparse.SUPPRESS)
    for name in ("--folder", "--report"):
        inside.add_argument(name, type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


PARTS = {
    "owner": run_owner,
    "actor": run_actor,
    "grpc-server": run_grpc_server,
    "grpc-client": run_grpc_client,
}
SYSTEMS = {"clothbus": measure_clothbus, "ray": measure_ray, "grpc": measure_grpc}


def main() -> None:
    arguments = parse_arguments()
    if arguments.part:
        PARTS[arguments.part](arguments)
        return
    for number in range(arguments.rounds):
        result = {name: measure(arguments.episodes) for name, measure in SYSTEMS.items()}
        keep_result(arguments.out, "delivery_load", {"round": number, **result})


if __name__ == "__main__":
    main()
