"""Failpoints: read strictly, spent once, and nothing at all without the variable."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from broker_config.errors import ConfigurationError
from broker_config.failpoints import FAILPOINT_VARIABLE, Failpoint, reach, read_armed

REACHES = """
from broker_config.failpoints import Failpoint, reach
for number in range(5):
    print(number, flush=True)
    reach(Failpoint.ACK_RECEIVED)
"""


def run(armed: str) -> subprocess.CompletedProcess[str]:
    environment = {FAILPOINT_VARIABLE: armed, "PYTHONPATH": str(Path.cwd())}
    return subprocess.run(
        [sys.executable, "-c", REACHES], env=environment, capture_output=True, text=True
    )


def test_a_process_is_killed_at_the_given_count_and_only_once(tmp_path: Path) -> None:
    armed = f"ack-received:3:{tmp_path / 'flag'};policy-updated:1:{tmp_path / 'other'}"
    first = run(armed)
    assert first.returncode == -9
    assert first.stdout.split() == ["0", "1", "2"]
    assert (tmp_path / "flag").exists()
    again = run(armed)
    assert again.returncode == 0
    assert again.stdout.split() == ["0", "1", "2", "3", "4"]
    assert not (tmp_path / "other").exists()


def test_a_failpoint_fires_again_when_its_flag_is_taken_away(tmp_path: Path) -> None:
    flag = tmp_path / "flag"
    flag.touch()
    assert run(f"ack-received:1:{flag}").returncode == 0
    flag.unlink()
    assert run(f"ack-received:1:{flag}").returncode == -9


def test_without_the_variable_nothing_happens() -> None:
    assert read_armed({}) == {}
    for point in Failpoint:
        reach(point)


@pytest.mark.parametrize(
    "wrong",
    ["nowhere:1:/tmp/flag", "ack-received", "ack-received:1:", "ack-received:x:/tmp/flag"],
)
def test_what_cannot_be_read_is_refused_with_the_names_there_are(wrong: str) -> None:
    with pytest.raises(ConfigurationError, match=r"expected point:count:flag file.*ack-received"):
        read_armed({FAILPOINT_VARIABLE: wrong})
    assert run(wrong).returncode == 1
