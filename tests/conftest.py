"""What tests share: a real router in a process of its own, and buses attached to it."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import hypothesis
import numpy as np
import pytest
import torch

from broker_config.bus import Bus, open_bus
from broker_config.messages import Role, Ticket, Trajectory, TrajectoryId

# A busy machine is no failure, and a test that passed passes again.
hypothesis.settings.register_profile(
    "clothbus",
    deadline=None,
    derandomize=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("clothbus")

torch.set_num_threads(1)  # as in every clothbus process; more would wait for each other

_ROUTER = """
import signal, sys
from broker_config.session import open_router_on_free_port, open_session
address = sys.argv[1] if len(sys.argv) > 1 else None
if address is None:
    session, address = open_router_on_free_port()
else:
    session = open_session("router", address)
with session:
    print(address, flush=True)
    signal.sigwait({signal.SIGTERM})
"""


class RouterProcess:
    """A router that can be killed, and started again at the same address."""

    def __init__(self) -> None:
        self._process = self._start()
        assert self._process.stdout is not None
        self.address = self._process.stdout.readline().strip()
        assert self.address, "the router did not start; its error is above"

    def _start(self, *arguments: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", _ROUTER, *arguments], stdout=subprocess.PIPE, text=True
        )

    def kill(self) -> None:
        """Ends it as a crash would."""
        self._process.send_signal(signal.SIGKILL)
        self._process.communicate()

    @contextlib.contextmanager
    def stopped(self) -> Iterator[None]:
        """Holds it, as if it hung: it listens, and answers nothing."""
        self._process.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self._process.send_signal(signal.SIGCONT)

    def restart(self) -> None:
        """Starts it again at the same address."""
        self._process = self._start(self.address)
        assert self._process.stdout is not None
        assert self._process.stdout.readline().strip() == self.address

    def close(self) -> None:
        """Ends it in order."""
        if self._process.returncode is None:
            self._process.terminate()
            self._process.communicate()


@pytest.fixture
def free_port() -> int:
    """A loopback port that nobody listened on a moment ago."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
    return port


@pytest.fixture
def own_router() -> Iterator[RouterProcess]:
    """A router for tests that kill it."""
    with contextlib.closing(RouterProcess()) as router:
        yield router


@pytest.fixture(scope="session")
def router() -> Iterator[RouterProcess]:
    """A router that tests share: use a run name of your own."""
    with contextlib.closing(RouterProcess()) as shared:
        yield shared


Attach = Callable[[Role, str], Bus]


@pytest.fixture
def run_name(request: pytest.FixtureRequest) -> str:
    """A run name that no other test uses."""
    return str(request.node.name).lower().replace("[", "-").replace("]", "")[:64]


@pytest.fixture
def attach(router: RouterProcess, run_name: str) -> Iterator[Attach]:
    """Attaches buses of this test's run to the shared router."""
    with contextlib.ExitStack() as stack:
        yield lambda role, name: stack.enter_context(open_bus(router.address, run_name, role, name))


def until_declared(bus: Bus) -> None:
    """Returns when the router has heard of everything that a bus serves and subscribes to.

    A question that comes earlier has nobody who serves it; a message has nobody who reads it.
    """
    bus.alive()  # a round trip on the same link


@pytest.fixture
def wait_until() -> Callable[..., None]:
    """Waits for a condition: `wait_until(lambda: x, 'x comes true')`."""

    def wait(condition: Callable[[], object], what: str, timeout_secs: float = 60.0) -> None:
        deadline = time.monotonic() + timeout_secs
        while not condition():
            assert time.monotonic() < deadline, f"waited {timeout_secs} s until {what}"
            time.sleep(0.002)  # between two looks at the condition

    return wait


@pytest.fixture
def make_trajectory() -> Callable[..., Trajectory]:
    """Makes trajectories whose pictures, actions and rewards follow from the sequence number."""

    def make(
        sequence: int = 0, actor: str = "actor-01", incarnation: str = "inc-1", steps: int = 3
    ) -> Trajectory:
        generator = np.random.default_rng(sequence)
        return Trajectory(
            id=TrajectoryId(actor, incarnation, sequence),
            ticket=Ticket(sequence, 0, 0, 7, 0, steps, 0.0),
            observations=generator.integers(0, 256, (steps + 1, 84, 84, 3), np.uint8),
            actions=generator.integers(0, 36, steps, np.int32),
            rewards=generator.random(steps, np.float32),
            terminated=False,
            truncated=True,
            success=False,
            guard=None,
            interrupted=False,
            ended_unix_secs=1.5,
        )

    return make
