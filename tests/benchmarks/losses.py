"""What gets lost: the same messages over three ways, with the same accidents on the way.

    python -m tests.benchmarks.losses --agentlace /path/to/python/with/agentlace

A sender makes 21 KB messages at a steady rate. In the middle one process has an accident. Counted
are the messages that the sender handed over, and those that the receiver noted in any life:

* clothbus: the actor's spool and delivery, and a learner with its journal;
* pubsub: plain Zenoh, reliable and blocking, through the same router;
* agentlace: a data store that updates the server after each message; it has no router.
"""

from __future__ import annotations

import argparse
import os
import secrets
import signal
import socket
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import zenoh

from actors.delivery import Delivery, wait_until
from broker_config.bus import open_bus
from broker_config.codec import decode
from broker_config.journal import JOURNAL_FILE, JournalReader
from broker_config.messages import Ticket, Trajectory
from broker_config.session import open_session
from broker_config.spool import Spool
from tests.benchmarks.measuring import RESULTS, Processes, Started, keep_result
from tests.benchmarks.number_log import Log

RUN, ACTOR = "losses", "sender"
KEY = f"{RUN}/plain"
PAYLOAD_BYTES = 21_000
STOP_SECS = 12.0
DOWN_SECS = 1.0
"""Between a kill and the next start."""
FLUSH_SECS = 60.0
END_SECS = 240.0
SPOOL_BYTES = 1 << 30
STEPS = 2
SHAPE = (STEPS + 1, 84, 84, 1)


# The two ends ------------------------------------------------------------------------------------


def paced(log: Log, count: int, rate: float, hand_over: Callable[[int], None]) -> None:
    """Hands over the messages that the log lacks, at a steady rate, and notes each."""
    began_secs, first = time.monotonic(), log.lines
    for number in range(first, count):
        time.sleep(max(0.0, began_secs + (number - first) / rate - time.monotonic()))
        hand_over(number)
        log.note(number)


def send_clothbus(address: str, log: Log, count: int, rate: float, spool_path: Path) -> None:
    incarnation = secrets.token_hex(8)
    with (
        open_bus(address, RUN, "actor", ACTOR) as bus,
        Spool(spool_path, RUN, ACTOR, incarnation, SPOOL_BYTES) as spool,
        Delivery(bus, spool, bus.keys.trajectory(ACTOR), lambda: 0) as delivery,
    ):
        delivery.notify()

        def hand_over(number: int) -> None:
            spool.put(_trajectory(spool, number))
            delivery.notify()

        paced(log, count, rate, hand_over)
        assert delivery.flush(wait_until(time.monotonic() + FLUSH_SECS)), "not all was acked"


def _trajectory(spool: Spool, number: int) -> Trajectory:
    """Random pictures; the number is in the time. No ticket asked for it: none must wait."""
    return Trajectory(
        id=spool.next_id(),
        ticket=Ticket(10**6, 0, 0, 0, 0, STEPS, 0.0),
        observations=np.frombuffer(os.urandom(int(np.prod(SHAPE))), np.uint8).reshape(SHAPE),
        actions=np.zeros(STEPS, np.int32),
        rewards=np.zeros(STEPS, np.float32),
        terminated=False,
        truncated=True,
        success=False,
        guard=None,
        interrupted=False,
        ended_unix_secs=float(number),
    )


def send_pubsub(address: str, log: Log, count: int, rate: float) -> None:
    with open_session("client", address) as session:
        publisher = session.declare_publisher(
            KEY,
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
        )

        def hand_over(number: int) -> None:
            publisher.put(number.to_bytes(8, "little") + os.urandom(PAYLOAD_BYTES))

        paced(log, count, rate, hand_over)
        time.sleep(2.0)  # what is on its way may arrive


def receive_pubsub(address: str, log: Log) -> None:
    with open_session("client", address) as session:
        subscriber = session.declare_subscriber(KEY, zenoh.handlers.FifoChannel(256))
        for sample in subscriber:
            log.note(int.from_bytes(sample.payload.to_bytes()[:8], "little"))


# The ways ----------------------------------------------------------------------------------------


@dataclass
class Scene:
    """What an accident may happen to."""

    sender: Started
    receiver: Started
    router: Started | None


@dataclass(frozen=True)
class Count:
    """Messages."""

    system: str
    accident: str
    sent: int
    arrived: int
    lost: int
    double: int


class Way:
    """Starts both ends of one way, and counts what arrived."""

    name = ""
    has_router = True

    def __init__(self, arguments: argparse.Namespace, folder: Path, processes: Processes) -> None:
        self.arguments = arguments
        self.folder = folder
        self.processes = processes
        self.sent_log = folder / "sent"
        self.arrived_log = folder / "arrived"

    def start(self) -> Scene:
        """Starts everything."""
        router, self.address = self.processes.router()
        receiver = self.start_receiver()
        return Scene(self.start_sender(), receiver, router)

    def start_receiver(self) -> Started:
        return self._end("receiver", "receive", self.arrived_log)

    def start_sender(self) -> Started:
        return self._end("sender", "send", self.sent_log)

    def arrived(self) -> Counter[int]:
        """How often each message arrived."""
        return read_log(self.arrived_log)

    def _end(self, name: str, part: str, log: Path) -> Started:
        return self.processes.start(
            name, "-m", "tests.benchmarks.losses", "--part", f"{part}-{self.name}",
            "--address", self.address, "--log", log, "--messages", self.arguments.messages,
            "--rate", self.arguments.rate, "--spool", self.folder / "spool",
        )  # fmt: skip


class PubSub(Way):
    name = "pubsub"


class Clothbus(Way):
    name = "clothbus"

    def start_receiver(self) -> Started:
        return self.processes.clothbus(
            "receiver", "learner", self.folder / RUN, "--preset", "reaching-smoke",
            "--connect", self.address, "--set", f"task.horizon={STEPS}",
        )  # fmt: skip

    def arrived(self) -> Counter[int]:
        found = Counter[int]()
        with JournalReader(self.folder / RUN / JOURNAL_FILE) as journal:
            for entry in journal:
                if entry.name.startswith("trajectory/"):
                    found[int(decode(entry.payload, Trajectory).ended_unix_secs)] += 1
        return found


class Agentlace(Way):
    name = "agentlace"
    has_router = False

    def start(self) -> Scene:
        with socket.create_server(("127.0.0.1", 0)) as probe:
            self.address = str(probe.getsockname()[1])
        receiver = self.start_receiver()
        return Scene(self.start_sender(), receiver, None)

    def _end(self, name: str, part: str, log: Path) -> Started:
        script = Path(__file__).with_name("agentlace_ends.py")
        count, rate = self.arguments.messages, self.arguments.rate
        python = str(self.arguments.agentlace)
        return self.processes.start(
            name, script, part, self.address, log, count, rate, python=python
        )


# The accidents -----------------------------------------------------------------------------------


def _nothing(_: Scene) -> None:
    pass


def _killed(which: Callable[[Scene], Started | None]) -> Callable[[Scene], None]:
    def accident(scene: Scene) -> None:
        victim = which(scene)
        assert victim is not None
        victim.kill()
        time.sleep(DOWN_SECS)
        victim.start()

    return accident


def _stopped(scene: Scene) -> None:
    scene.receiver.send(signal.SIGSTOP)
    time.sleep(STOP_SECS)
    scene.receiver.send(signal.SIGCONT)


ACCIDENTS: dict[str, Callable[[Scene], None]] = {
    "none": _nothing,
    "receiver: kill -9, started again": _killed(lambda scene: scene.receiver),
    f"receiver: stopped for {STOP_SECS:.0f} s": _stopped,
    "sender: kill -9, started again": _killed(lambda scene: scene.sender),
    "router: kill -9, started again": _killed(lambda scene: scene.router),
}


def count(way: type[Way], accident: str, arguments: argparse.Namespace) -> Count:
    """One way with one accident when a third of the messages has been handed over."""
    with tempfile.TemporaryDirectory() as name, Processes(Path(name)) as processes:
        one = way(arguments, Path(name), processes)
        scene = one.start()
        _wait_for_messages(one, scene, arguments.messages // 3)
        ACCIDENTS[accident](scene)
        scene.sender.wait(END_SECS + arguments.messages / arguments.rate)
        scene.receiver.close()
        sent, arrived = read_log(one.sent_log), one.arrived()
        missing = sum(number not in arrived for number in sent)
        double = sum(times - 1 for times in arrived.values())
        return Count(one.name, accident, len(sent), len(arrived), missing, double)


def _wait_for_messages(way: Way, scene: Scene, messages: int) -> None:
    deadline_secs = time.monotonic() + END_SECS
    while len(read_log(way.sent_log)) < messages:
        for started in (scene.sender, scene.receiver):
            assert started.process.poll() is None, started.said()
        assert time.monotonic() < deadline_secs, "the sender does not get on"
        time.sleep(0.05)


def read_log(path: Path) -> Counter[int]:
    """How often each number is in a log."""
    return Counter(map(int, path.read_text().split())) if path.exists() else Counter()


def measure(arguments: argparse.Namespace) -> list[Count]:
    """Every way with every accident that can happen to it."""
    ways: list[type[Way]] = [Clothbus, PubSub]
    if arguments.agentlace:
        subprocess.run([str(arguments.agentlace), "-c", "import agentlace.trainer"], check=True)
        ways.append(Agentlace)
    else:
        print("agentlace: left out, for --agentlace names no interpreter that has it")
    counts = []
    for accident in ACCIDENTS:
        for way in ways:
            if way.has_router or not accident.startswith("router"):
                counts.append(count(way, accident, arguments))
                print(counts[-1], flush=True)
    return counts


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--messages", type=int, default=2000)
    parser.add_argument("--rate", type=float, default=100.0, help="messages a second")
    parser.add_argument("--agentlace", type=Path, help="an interpreter that has agentlace")
    parser.add_argument("--out", type=Path, default=RESULTS)
    inside = parser.add_argument_group("of one end")
    for name in ("--part", "--address"):
        inside.add_argument(name, help=argparse.SUPPRESS)
    for name in ("--log", "--spool"):
        inside.add_argument(name, type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    given = parse_arguments()
    if given.part is None:
        counts = measure(given)
        rows = [asdict(it) for it in counts]
        keep_result(given.out, "losses", {"rate": given.rate, "counts": rows})
        ours = [it for it in counts if it.system == Clothbus.name]
        assert all(it.lost == 0 and it.double == 0 for it in ours), "clothbus lost or doubled"
        return
    log = Log(given.log)
    match given.part:
        case "send-clothbus":
            send_clothbus(given.address, log, given.messages, given.rate, given.spool)
        case "send-pubsub":
            send_pubsub(given.address, log, given.messages, given.rate)
        case "receive-pubsub":
            receive_pubsub(given.address, log)


if __name__ == "__main__":
    main()
