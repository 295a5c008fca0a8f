"""What the status of a run says of processes that hang."""

from __future__ import annotations

import io

from rich.console import Console

from broker_config.heart import HUNG_SECS
from broker_config.messages import Heartbeat
from deploy.commands.status import ProcessStatus, status_table


def shown(*processes: ProcessStatus) -> str:
    console = Console(file=io.StringIO(), width=200)
    console.print(status_table("run", list(processes)))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def actor(name: str, stalled_secs: float) -> ProcessStatus:
    numbers = {"policy_version": 3.0, "spooled": 2.0}
    heartbeat = Heartbeat("actor", name, "life", "host", 7, "collecting", stalled_secs, numbers)
    return ProcessStatus("actor", name, heartbeat)


def test_silence_and_a_standstill_are_told_apart_from_work() -> None:
    text = shown(
        actor("busy", HUNG_SECS / 2),
        actor("stuck", HUNG_SECS + 40),
        ProcessStatus("actor", "silent", None),
    )
    busy, stuck, silent = (line for line in text.splitlines() if "actor" in line)
    assert "collecting" in busy
    assert "hangs: main thread at a standstill for 100 s" in stuck
    assert "hangs: alive, but silent" in silent
