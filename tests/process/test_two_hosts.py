"""Two hosts: router and learner on one, an actor on the other, and a bad cable between them.

Each host is a network namespace; a veth pair is the cable. It loses 1 % of the packets in either
direction throughout, and is pulled out for 20 s.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from broker_config.codec import decode
from broker_config.errors import StorageError
from broker_config.journal import JOURNAL_FILE, JournalReader
from broker_config.messages import AttemptEnded
from tests.process.accounting import settle
from tests.process.conftest import Command, undisturbed_weights, weights

CUT_SECS = 20.0
LOSS = 0.01
HORIZON = 10
SETTINGS = ("schedule.iterations=12", "task.options.n_joints=5", "task.n_actions=25")
EPISODES = 24

LEARNER_HOST, ACTOR_HOST = "learner", "actor"
ADDRESSES = {LEARNER_HOST: "10.77.0.1", ACTOR_HOST: "10.77.0.2"}
DEVICE = "cable"

_RANDOM_NUMBER = 0xFFFFF000 + 56
"""Where a classic BPF program loads 32 random bits from."""


@dataclass(frozen=True)
class Hosts:
    """The two namespaces, by the name of the host."""

    namespaces: dict[str, str]

    def within(self, host: str) -> list[str]:
        """What to put before a command that is to run on a host."""
        return ["ip", "netns", "exec", self.namespaces[host]]

    def set_cable(self, state: str) -> None:
        """Pulls the cable at the learner's end, or plugs it in again: "down", "up"."""
        system("ip", "-n", self.namespaces[LEARNER_HOST], "link", "set", DEVICE, state)

    def lose_packets(self) -> None:
        """Loses a share of the packets in both directions."""
        for namespace in self.namespaces.values():
            try:
                system("tc", "-n", namespace, *_ON_DEVICE, "root", "netem", "loss", f"{LOSS:.0%}")
            except subprocess.CalledProcessError:
                _lose_by_classifier(namespace)  # this kernel has no netem

    def lost_packets(self) -> int:
        """How many were lost up to now."""
        total = 0
        for namespace in self.namespaces.values():
            command = ["tc", "-n", namespace, "-j", "-s", "qdisc", "show", "dev", DEVICE]
            shown = subprocess.run(command, check=True, capture_output=True, text=True)
            total += json.loads(shown.stdout)[0]["drops"]
        return total


_ON_DEVICE = ("qdisc", "add", "dev", DEVICE)


def _lose_by_classifier(namespace: str) -> None:
    """Sends a random share of the packets into a class that drops everything."""
    tc = ("tc", "-n", namespace)
    system(*tc, *_ON_DEVICE, "root", "handle", "1:", "htb", "default", "1")
    for number in (1, 2):
        of_class = ("classid", f"1:{number}", "htb", "rate", "1gbit", "quantum", "60000")
        system(*tc, "class", "add", "dev", DEVICE, "parent", "1:", *of_class)
    system(*tc, *_ON_DEVICE, "parent", "1:2", "blackhole")
    # Load a random number; from the threshold on, no match (0), below it, a match (all ones).
    threshold = int(LOSS * 2**32)
    program = f"4,32 0 0 {_RANDOM_NUMBER},53 1 0 {threshold},6 0 0 {2**32 - 1},6 0 0 0"
    to_dropped = ("bpf", "bytecode", program, "classid", "1:2")
    system(*tc, "filter", "add", "dev", DEVICE, "parent", "1:", *to_dropped)


def system(*command: str) -> None:
    """Carries out a command; its output is in the error."""
    subprocess.run(command, check=True, capture_output=True, text=True)


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    if os.geteuid() != 0 or shutil.which("ip") is None or shutil.which("tc") is None:
        pytest.skip("network namespaces: need root, and ip and tc of iproute2")
    namespaces = {host: f"clothbus-{os.getpid()}-{host}" for host in ADDRESSES}
    with contextlib.ExitStack() as stack:
        for namespace in namespaces.values():
            try:
                system("ip", "netns", "add", namespace)
            except subprocess.CalledProcessError as error:
                pytest.skip(f"network namespaces: cannot be made here; {error.stderr.strip()}")
            stack.callback(system, "ip", "netns", "delete", namespace)  # and its end of the cable
        _connect(namespaces)
        yield Hosts(namespaces)


def _connect(namespaces: dict[str, str]) -> None:
    here, there = namespaces[LEARNER_HOST], namespaces[ACTOR_HOST]
    veth = ("type", "veth", "peer", "name", DEVICE, "netns", there)
    system("ip", "-n", here, "link", "add", DEVICE, *veth)
    for host, namespace in namespaces.items():
        in_host = ("ip", "-n", namespace)
        system(*in_host, "address", "add", f"{ADDRESSES[host]}/24", "dev", DEVICE)
        # Packets of a real cable's size: otherwise one loss would be one of 64 KB.
        system(*in_host, "link", "set", "dev", DEVICE, "gso_max_segs", "1", "up")
        system(*in_host, "link", "set", "dev", "lo", "up")


class HostCommand(Command):
    """A clothbus command that runs on one of the hosts."""

    def __init__(self, hosts: Hosts, host: str, log: Path, *arguments: object) -> None:
        self.log = log
        command = [*hosts.within(host), sys.executable, "-m", "deploy.cli", *map(str, arguments)]
        with log.open("ab") as output:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )


StartOn = Callable[..., HostCommand]


@pytest.fixture
def start_on(hosts: Hosts, tmp_path: Path) -> Iterator[StartOn]:
    """Starts clothbus commands on a host, and ends them before the hosts."""
    with contextlib.ExitStack() as stack:

        def start_one(host: str, name: str, *arguments: object) -> HostCommand:
            command = HostCommand(hosts, host, tmp_path / f"{name}.log", *arguments)
            stack.callback(command.close)
            return command

        yield start_one


def delivered_by(folder: Path, actor: str) -> int:
    """How many trajectories of an actor the journal holds."""
    try:
        with JournalReader(folder / JOURNAL_FILE) as journal:
            return len(journal.entries(prefix=f"ended/{actor}/"))
    except StorageError:
        return 0  # the learner has not made it yet


def wait_for_delivery(folder: Path, actor: str, count: int, command: Command) -> None:
    deadline = time.monotonic() + 120
    while delivered_by(folder, actor) < count:
        assert command.process.poll() is None, command.log.read_text()[-3000:]
        assert time.monotonic() < deadline, f"{actor}: {delivered_by(folder, actor)} of {count}"
        time.sleep(0.02)


@pytest.mark.timeout(500)
def test_a_far_actor_survives_lost_packets_and_a_pulled_cable(
    hosts: Hosts, start_on: StartOn, tmp_path: Path
) -> None:
    folder, step_log = tmp_path / "run", tmp_path / "steps.jsonl"
    address = f"tcp/{ADDRESSES[LEARNER_HOST]}:7447"

    def start_actor(host: str, name: str, log: str) -> HostCommand:
        return start_on(
            host, log, "actor", "--id", name, "--connect", address, "--run", "run",
            "--spool", tmp_path / f"{name}.sqlite", "--step-log", step_log,
        )  # fmt: skip

    hosts.lose_packets()
    start_on(LEARNER_HOST, "router", "router", "--listen", address)
    learner = start_on(
        LEARNER_HOST, "learner", "learner", folder, "--preset", "reaching-smoke",
        "--connect", address, "--set", *SETTINGS,
    )  # fmt: skip
    far = start_actor(ACTOR_HOST, "far", "far")
    wait_for_delivery(folder, "far", 3, far)

    hosts.set_cable("down")
    pulled_secs = time.monotonic()
    near = start_actor(LEARNER_HOST, "near", "near")
    wait_for_delivery(folder, "near", 2, near)
    near.kill()  # or it would collect all the rest
    while time.monotonic() < pulled_secs + CUT_SECS:
        assert far.process.poll() is None, far.log.read_text()[-3000:]
        assert learner.process.poll() is None, learner.log.read_text()[-3000:]
        time.sleep(0.1)  # the cut takes its time
    before = delivered_by(folder, "far")
    hosts.set_cable("up")
    wait_for_delivery(folder, "far", before + 2, far)
    start_actor(LEARNER_HOST, "near", "near-again")  # delivers what its spool still holds
    assert learner.wait(200) == 0, learner.log.read_text()[-3000:]
    assert far.wait(60) == 0, far.log.read_text()[-3000:]

    account = settle(step_log, folder / JOURNAL_FILE)
    assert account.acted == account.journalled + account.cut_off
    assert account.cut_off <= HORIZON, "only the episode in which one actor was killed"
    assert dict(account.accepted) == dict.fromkeys(range(EPISODES), HORIZON)
    assert not _seen_twice(folder)
    assert hosts.lost_packets() > 0
    assert weights(folder) == undisturbed_weights(tmp_path / "undisturbed", *SETTINGS)


def _seen_twice(folder: Path) -> list[str]:
    """Trajectories that the journal judges more than once."""
    with JournalReader(folder / JOURNAL_FILE) as journal:
        ended = [decode(it.payload, AttemptEnded) for it in journal.entries(prefix="ended/")]
    ids = [str(it.trajectory) for it in ended]
    return [id_ for id_ in set(ids) if ids.count(id_) > 1]


@pytest.mark.parametrize(
    "address",
    [
        pytest.param("tcp/10.77.0.1:7448", id="another port"),
        pytest.param("tcp/10.77.0.99:7447", id="no such host"),
    ],
)
def test_a_wrong_address_is_named_with_what_to_do(
    start_on: StartOn, address: str, tmp_path: Path
) -> None:
    # A spool of its own: both cases may run at once.
    options = "--connect", address, "--run", "run", "--spool", tmp_path / "spool.sqlite"
    actor = start_on(ACTOR_HOST, "lost", "actor", *options)
    assert actor.wait(60) == 4, actor.log.read_text()
    said = " ".join(actor.log.read_text().split())
    assert f"router: expected an answer at {address}; got none" in said
    assert "check the address, the firewall" in said
