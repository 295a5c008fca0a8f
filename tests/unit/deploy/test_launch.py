"""The supervisor, with real processes."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from deploy.launch import SHORT_LIVES_BEFORE_GIVING_UP, ProcessFailed, Supervisor
from deploy.process import CONFIGURATION_EXIT
from deploy.topology import ProcessSpec


@dataclass(frozen=True)
class Script(ProcessSpec):
    """A process that runs a piece of Python."""

    code: str = ""

    @property
    def command(self) -> list[str]:
        return [sys.executable, "-c", self.code]


def script(name: str, code: str) -> Script:
    return Script("actor", name, (), code)


FOREVER = "import time; print('up', flush=True); time.sleep(600)"


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


def test_success_is_the_end(tmp_path: Path) -> None:
    with Supervisor(tmp_path) as supervisor:
        process = supervisor.start(script("a", "print('once')"))
        assert supervisor.wait_finished(["a"], 20)
        supervisor.check()
        assert process.restarts == 0
    assert (tmp_path / "a.log").read_text() == "once\n"


def test_an_error_of_configuration_is_not_tried_again(tmp_path: Path) -> None:
    code = f"import sys; print('clothbus: a wrong key'); sys.exit({CONFIGURATION_EXIT})"
    with Supervisor(tmp_path) as supervisor:
        supervisor.start(script("a", code))
        with pytest.raises(ProcessFailed, match=r"a ended with code 3: clothbus: a wrong key"):
            supervisor.wait_finished(["a"], 20)


def test_a_process_that_keeps_dying_at_once_ends_the_run(tmp_path: Path) -> None:
    with Supervisor(tmp_path) as supervisor:
        process = supervisor.start(script("a", "raise SystemExit(1)"))
        with pytest.raises(ProcessFailed, match=r"code 1: it wrote nothing"):
            supervisor.wait_finished(["a"], 20)
        assert process.restarts == SHORT_LIVES_BEFORE_GIVING_UP - 1


def test_a_stopped_process_can_be_ended(tmp_path: Path) -> None:
    with Supervisor(tmp_path) as supervisor:
        process = supervisor.start(script("a", FOREVER))
        assert process.pid is not None
        os.kill(process.pid, signal.SIGSTOP)
    with pytest.raises(ProcessLookupError):
        os.kill(process.pid, 0)
