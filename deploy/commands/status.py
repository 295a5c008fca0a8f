"""`clothbus status` and `control`: who is alive, what they say of themselves, who is silent."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

from rich.table import Table

from broker_config.bus import Bus, open_bus
from broker_config.errors import OwnerUnreachable
from broker_config.heart import HUNG_SECS
from broker_config.keys import Kind, ParsedKey
from broker_config.liveliness import runs_on
from broker_config.messages import Command, Control, ControlReply, Heartbeat
from broker_config.session import open_session

CONTROL_TIMEOUT_SECS = 5.0

LISTEN_SECS = 1.5
"""Three heartbeats: a process that lives and says nothing for this long hangs."""


@dataclass(frozen=True)
class ProcessStatus:
    """One living process."""

    role: str
    id: str
    heartbeat: Heartbeat | None
    """None: the process lives, but hangs."""


def only_run(address: str, overrides: tuple[str, ...] = ()) -> str:
    """The one run that a router carries.

    Raises:
        OwnerUnreachable: It carries none, or several.
    """
    with open_session("client", address, overrides) as session:
        runs = runs_on(session)
    if len(runs) != 1:
        found = ", ".join(runs) or "none"
        raise OwnerUnreachable(
            f"router {address}: expected one run; got {found}; "
            "start one with `clothbus run`, or name it with --run"
        )
    return runs[0]


def send_control(
    address: str,
    run: str,
    command: Command,
    process: str | None = None,
    overrides: tuple[str, ...] = (),
) -> ControlReply:
    """Has the owner of a run do something.

    Raises:
        OwnerUnreachable: Nobody answers.
        RouterUnreachable: There is no router at the address.
    """
    with open_bus(address, run, "observer", "control", overrides) as bus:
        request = Control(command, process)
        return bus.ask(bus.keys.control, request, ControlReply, timeout_secs=CONTROL_TIMEOUT_SECS)


def read_status(address: str, run: str, overrides: tuple[str, ...] = ()) -> list[ProcessStatus]:
    """Asks who is alive and listens until everybody has said something, or too long.

    Raises:
        RouterUnreachable: There is no router at the address.
    """
    with open_bus(address, run, "observer", "status", overrides) as bus:
        return listen(bus)


def listen(bus: Bus) -> list[ProcessStatus]:
    """The status by way of an open bus."""
    heard: dict[tuple[str, str], Heartbeat] = {}
    changed = threading.Condition()

    def on_heartbeat(_: ParsedKey, heartbeat: Heartbeat) -> None:
        with changed:
            heard[heartbeat.role, heartbeat.id] = heartbeat
            changed.notify_all()

    bus.subscribe(bus.keys.every(Kind.LIVE), Heartbeat, on_heartbeat)
    alive = {(str(key.role), str(key.id)) for key in bus.alive()}
    deadline_secs = time.monotonic() + LISTEN_SECS
    with changed:
        while not alive <= heard.keys() and time.monotonic() < deadline_secs:
            changed.wait(deadline_secs - time.monotonic())
        return [ProcessStatus(role, id_, heard.get((role, id_))) for role, id_ in sorted(alive)]


def status_table(run: str, processes: list[ProcessStatus]) -> Table:
    """The status as a table for a terminal."""
    owner = next((item.heartbeat for item in processes if item.role == "owner"), None)
    numbers = owner.numbers if owner else {}
    table = Table(title=_title(run, processes))
    for column in ("role", "id", "host", "state", "policy", "lag", "spooled"):
        table.add_column(column)
    for process in processes:
        beat = process.heartbeat
        if beat is None:
            table.add_row(process.role, process.id, "?", "[red]hangs: alive, but silent[/red]")
            continue
        if beat.stalled_secs > HUNG_SECS:
            standstill = f"hangs: main thread at a standstill for {beat.stalled_secs:.0f} s"
            table.add_row(process.role, process.id, beat.host, f"[red]{standstill}[/red]")
            continue
        version = beat.numbers.get("policy_version")
        newest = numbers.get("policy_version")
        lag = None
        if process.role == "actor" and version is not None and newest is not None:
            lag = newest - version
        table.add_row(
            process.role,
            process.id,
            beat.host,
            beat.state,
            _count(version),
            _count(lag),
            _count(beat.numbers.get("spooled")),
        )
    return table


def _title(run: str, processes: list[ProcessStatus]) -> str:
    owner = next((item for item in processes if item.role == "owner"), None)
    if owner is None:
        return f"{run}: no learner"
    if owner.heartbeat is None:
        return f"{run}: the learner hangs"
    numbers = owner.heartbeat.numbers
    iteration, episode = numbers.get("iteration", 0), numbers.get("episode", 0)
    return f"{run}: iteration {iteration:.0f}, episode {episode:.0f}, {owner.heartbeat.state}"


def _count(value: float | None) -> str:
    return "" if value is None else f"{value:.0f}"
