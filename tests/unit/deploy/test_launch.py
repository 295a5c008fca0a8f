"""The supervisor, with real processes."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from broker_config.keys import parse_key
from broker_config.messages import Heartbeat
from deploy.process import CONFIGURATION_EXIT, TERMINATED_EXIT, UNREACHABLE_EXIT
from deploy.running.launch import SHORT_LIVES_BEFORE_GIVING_UP, ProcessFailed, Supervisor
from deploy.running.topology import ProcessSpec
from deploy.running.vital_signs import VitalSigns


@dataclass(frozen=True)
class Script(ProcessSpec):
    """A process that runs a piece of Python."""

    code: str = ""

    @property
    def command(self) -> list[str]:
        return [sys.executable, "-c", self.code]


def script(name: str, code: str) -> Script:
    return Script("actor", name, (), code)


# In short sleeps: a signal just before a long one would be looked at only after it.
FOREVER = "import time; print('up', flush=True); [time.sleep(0.05) for _ in range(12000)]"


def wait_for(condition, supervisor: Supervisor, what: str) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline, what
        supervisor.check()
        time.sleep(0.01)


def test_a_killed_process_is_started_again(tmp_path: Path) -> None:
    with Supervisor(tmp_path) as supervisor:
        process = supervisor.start(script("a", FOREVER))
        first = process.pid
        assert first is not None
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: process.restarts == 1, supervisor, "a restart")
        second = process.pid
        assert second not in (None, first)
    with pytest.raises(ProcessLookupError):
        os.kill(int(second or 0), 0)


def beat(signs: VitalSigns, pid: int | None, stalled_secs: float = 0.0) -> None:
    assert pid is not None
    heartbeat = Heartbeat("actor", "a", "life", "host", pid, "acting", stalled_secs, {})
    signs.on_heartbeat(parse_key("run/live/actor/a"), heartbeat)


def test_success_is_the_end(tmp_path: Path) -> None:
    with Supervisor(tmp_path) as supervisor:
        process = supervisor.start(script("a", "print('once')"))
        wait_for(lambda: supervisor.has_finished("a"), supervisor, "its end")
        supervisor.check()
        assert process.restarts == 0
    assert (tmp_path / "a.log").read_text() == "once\n"


def test_an_error_of_configuration_is_not_tried_again(tmp_path: Path) -> None:
    code = f"import sys; print('clothbus: a wrong key'); sys.exit({CONFIGURATION_EXIT})"
    with Supervisor(tmp_path) as supervisor:
        supervisor.start(script("a", code))
        with pytest.raises(ProcessFailed, match=r"a ended with code 3: clothbus: a wrong key"):
            wait_for(lambda: False, supervisor, "an error")


def test_a_process_that_keeps_dying_at_once_ends_the_run(tmp_path: Path) -> None:
    with Supervisor(tmp_path) as supervisor:
        process = supervisor.start(script("a", "raise SystemExit(1)"))
        began_secs = time.monotonic()
        with pytest.raises(ProcessFailed, match=r"code 1: it wrote nothing"):
            wait_for(lambda: False, supervisor, "an error")
        assert process.restarts == SHORT_LIVES_BEFORE_GIVING_UP - 1
        assert time.monotonic() - began_secs > 0.5 + 1 + 2, "it was not left in peace in between"


@pytest.mark.parametrize("ending", ["kill", "terminate"])
def test_a_process_that_is_killed_often_but_gets_somewhere_is_kept_alive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    monkeypatch.setattr("deploy.running.launch.PAUSES_SECS", (0.0,))
    signs = VitalSigns()
    leave = f"import signal, sys; signal.signal(15, lambda *_: sys.exit({TERMINATED_EXIT})); "
    with Supervisor(tmp_path, signs) as supervisor:
        process = supervisor.start(script("a", leave + FOREVER))
        log = tmp_path / "a.log"
        for life in range(1, SHORT_LIVES_BEFORE_GIVING_UP + 2):
            wait_for(lambda life=life: log.read_text() == "up\n" * life, supervisor, "its start")
            beat(signs, process.pid)
            assert process.process is not None
            getattr(process.process, ending)()
            wait_for(lambda life=life: process.restarts == life, supervisor, "a restart")


def test_a_router_that_is_killed_often_but_carries_heartbeats_is_kept_alive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deploy.running.launch.PAUSES_SECS", (0.0,))
    signs = VitalSigns()
    with Supervisor(tmp_path, signs) as supervisor:
        process = supervisor.start(Script("router", "router", (), FOREVER))
        for life in range(1, SHORT_LIVES_BEFORE_GIVING_UP + 2):
            beat(signs, 1)  # another process's, by way of the router
            assert process.process is not None
            process.process.kill()
            wait_for(lambda life=life: process.restarts == life, supervisor, "a restart")
        for _ in range(SHORT_LIVES_BEFORE_GIVING_UP - 1):
            restarts = process.restarts
            process.process.kill()
            wait_for(lambda n=restarts: process.restarts > n, supervisor, "a restart")
        process.process.kill()
        with pytest.raises(ProcessFailed, match="router ended with code -9"):
            wait_for(lambda: False, supervisor, "nothing was heard through any of these")


def test_a_router_that_is_away_for_a_while_does_not_end_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deploy.running.launch.PAUSES_SECS", (0.0,))
    signs = VitalSigns()
    beat(signs, 1)  # so there was a router
    with Supervisor(tmp_path, signs) as supervisor:
        process = supervisor.start(script("a", f"raise SystemExit({UNREACHABLE_EXIT})"))
        wait_for(
            lambda: process.restarts > SHORT_LIVES_BEFORE_GIVING_UP, supervisor, "many restarts"
        )


def test_a_process_at_a_standstill_is_killed_and_started_again(tmp_path: Path) -> None:
    signs = VitalSigns(hung_secs=30.0)
    signs._chance_secs -= 100.0  # as if it had been watched for so long
    with Supervisor(tmp_path, signs) as supervisor:
        process = supervisor.start(script("a", FOREVER))
        first = process.pid
        beat(signs, first, stalled_secs=29.0)
        supervisor.check()
        assert process.restarts == 0
        beat(signs, first, stalled_secs=31.0)
        wait_for(lambda: process.restarts == 1, supervisor, "a restart")
        assert process.pid != first


def test_a_stopped_process_can_be_ended(tmp_path: Path) -> None:
    with Supervisor(tmp_path) as supervisor:
        process = supervisor.start(script("a", FOREVER))
        assert process.pid is not None
        os.kill(process.pid, signal.SIGSTOP)
    with pytest.raises(ProcessLookupError):
        os.kill(process.pid, 0)
