"""Giving way: the player's thread and its children only, and the session where it is our own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="priorities of threads")

_PROGRAM = """
import json, os, subprocess, sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from deploy.priority import give_way

ASK = [sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"]

def look():
    child = subprocess.run(ASK, capture_output=True, text=True, check=True, process_group=0)
    autogroup = Path("/proc/self/autogroup")
    group = autogroup.read_text() if autogroup.exists() else ""
    return os.sched_getscheduler(0), int(child.stdout), group.strip()

with ThreadPoolExecutor(1, initializer=give_way) as thread:
    inside = thread.submit(look).result()
print(json.dumps({"inside": inside, "outside": look()}))
"""

IDLE, NORMAL = 5, 0
"""SCHED_IDLE and SCHED_OTHER."""


def priorities(own_session: bool) -> dict[str, list[object]]:
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM],
        capture_output=True,
        text=True,
        check=True,
        start_new_session=own_session,
    )
    found: dict[str, list[object]] = json.loads(done.stdout)
    return found


def test_a_thread_gives_way_with_its_children_and_the_others_do_not() -> None:
    found = priorities(own_session=True)
    assert found["inside"][:2] == [IDLE, IDLE]
    assert found["outside"][:2] == [NORMAL, NORMAL]


@pytest.mark.skipif(not Path("/proc/self/autogroup").exists(), reason="no groups of sessions")
def test_a_session_gives_way_only_if_it_is_our_own() -> None:
    # "/autogroup-1975 nice 19"; nothing at all in the session that the machine started with.
    assert str(priorities(own_session=True)["inside"][2]).endswith(" 19")
    ours = Path("/proc/self/autogroup").read_text().strip()
    assert priorities(own_session=False)["inside"][2] == ours
