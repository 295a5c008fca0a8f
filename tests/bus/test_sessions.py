"""Sessions: configuration, addresses, lost routers and the end of processes."""

import subprocess
import sys
import threading
import time

import pytest

from broker_config.bus import open_bus
from broker_config.errors import (
    AddressInUse,
    ConfigurationError,
    OwnerUnreachable,
    RouterUnreachable,
)
from broker_config.keys import Kind
from broker_config.liveliness import runs_on
from broker_config.messages import (
    Command,
    Control,
    ControlReply,
    Instruction,
    TicketReply,
    TicketRequest,
)
from broker_config.session import open_router_on_free_port, open_session
from tests.conftest import until_declared


def test_an_unreachable_router_is_reported_within_the_timeout(free_port):
    address = f"tcp/127.0.0.1:{free_port}"
    started = time.monotonic()
    with pytest.raises(RouterUnreachable, match=f"clothbus router --listen {address}"):
        open_session("client", address, ["connect/timeout_ms=300"])
    assert time.monotonic() - started < 4.5, "without the override it is 5 s"


@pytest.mark.parametrize(
    "override", ["nope/x=1", 'scouting/multicast/enabled="maybe"', "mode=client", "lease"]
)
def test_an_override_that_cannot_be_used_is_named_with_its_origin(override):
    key = override.partition("=")[0]
    with pytest.raises(ConfigurationError, match=f"'{key}.*from the command line: expected"):
        open_session("client", overrides=[override])


def test_the_environment_is_named_as_well():
    environment = {"CLOTHBUS_ZENOH_OVERRIDE": "transport/link/tx/lease=1500; nope=1"}
    with pytest.raises(ConfigurationError, match="'nope' from environment variable CLOTHBUS_ZEN"):
        open_session("client", environment=environment)


def test_an_address_without_a_protocol_is_a_configuration_error():
    with pytest.raises(ConfigurationError, match="from the given address"):
        open_session("client", "127.0.0.1:7447")


def test_a_router_does_not_share_its_address(router):
    with pytest.raises(AddressInUse, match=f"got {router.address}, where another process listens"):
        open_session("router", router.address)


def test_routers_that_start_side_by_side_get_ports_of_their_own():
    first, first_address = open_router_on_free_port()
    second, second_address = open_router_on_free_port()
    with first, second:
        assert first_address != second_address
        with open_session("client", first_address) as client:
            assert runs_on(client) == []


def test_a_client_may_start_before_its_router(free_port):
    address = f"tcp/127.0.0.1:{free_port}"
    opened = []

    def attach():
        with open_bus(address, "run", "actor", "early") as bus:
            opened.append(bus.has_router())

    thread = threading.Thread(target=attach)
    thread.start()
    with open_session("router", address):
        thread.join(20)
    assert opened == [True]


def test_a_router_that_listens_but_hangs_is_waited_for(own_router, monkeypatch, wait_until):
    hasty = ["connect/timeout_ms=300", "transport/unicast/open_timeout=300"]
    opened = []

    def attach():
        with open_session("client", own_router.address, hasty):
            opened.append(True)

    with own_router.stopped():
        with monkeypatch.context() as patch:
            patch.setattr("broker_config.session.BUSY_ROUTER_SECS", 0.0)
            with pytest.raises(RouterUnreachable):
                open_session("client", own_router.address, hasty)
        thread = threading.Thread(target=attach)
        thread.start()
        thread.join(1.0)  # three times what a router has that nobody listens for
        assert not opened
        assert thread.is_alive()
    wait_until(lambda: opened, "the router goes on")
    thread.join()


def test_an_asker_gets_its_answer_after_the_router_was_killed_and_restarted(own_router, wait_until):
    def answer(key, request, responder):
        responder.reply(ControlReply(request.command, "paused"))

    with (
        open_bus(own_router.address, "run", "owner", "learner") as owner,
        open_bus(own_router.address, "run", "observer", "console") as console,
    ):
        owner.serve(owner.keys.control, Control, answer)
        owner.declare_alive()
        until_declared(owner)
        failures = []

        def is_answered():
            try:
                console.ask(
                    console.keys.control, Control(Command.PAUSE), ControlReply, timeout_secs=2
                )
            except OwnerUnreachable as error:
                failures.append(str(error))
                return False
            return True

        assert is_answered()
        own_router.kill()
        wait_until(lambda: not console.has_router(), "the loss is noticed")
        assert not is_answered()
        assert "no connection to a router" in failures[0]
        with pytest.raises(RouterUnreachable):
            console.alive()
        own_router.restart()
        wait_until(is_answered, "the question is answered again")
        wait_until(lambda: console.alive(), "the owner's token is back")


def test_the_owners_restart_is_bridged_by_asking_again(attach, wait_until):
    asker = attach("actor", "a")
    request = TicketRequest("a", "inc-1", "n")

    def ask():
        try:
            key = asker.keys.ticket("a")
            return asker.ask(key, request, TicketReply, timeout_secs=5).owner_epoch
        except OwnerUnreachable:
            return None

    for epoch in (1, 2):
        owner = attach("owner", "learner")
        owner.serve(
            owner.keys.every(Kind.TICKET),
            TicketRequest,
            lambda key, request, responder, epoch=epoch: responder.reply(
                TicketReply(Instruction.WAIT, request.nonce, epoch)
            ),
        )
        wait_until(lambda: ask() == epoch, f"epoch {epoch} answers")  # noqa: B023  # used at once
        owner.close()
        assert ask() is None


UNCLOSED = """
import sys
from broker_config.bus import Bus
from broker_config.keys import Kind
from broker_config.messages import Control, Metrics, Snapshot
from broker_config.session import open_session
bus = Bus(open_session("client", sys.argv[1]), "unclosed", "owner", "learner")
bus.serve(bus.keys.control, Control, lambda *_: None)
bus.subscribe(bus.keys.every(Kind.METRICS), Metrics, lambda *_: None)
bus.latest_reader(bus.keys.policy, Snapshot)
bus.latest_publisher(bus.keys.policy)
bus.declare_alive()
bus.watch_alive(lambda *_: None)
sys.exit(7) if sys.argv[2] == "exit" else int("raise")
"""


@pytest.mark.parametrize(("way", "status"), [("exit", 7), ("raise", 1)])
def test_a_process_that_closes_nothing_still_ends(router, way, status):
    ended = subprocess.run(
        [sys.executable, "-c", UNCLOSED, router.address, way],
        timeout=60,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == status, ended.stderr
