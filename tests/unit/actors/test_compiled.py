"""What is compiled is kept where there is a place for it, and works where there is none."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

PROGRAM = """
from actors.compiled import compiler

@compiler()
def twice(x):
    return 2 * x

print(twice(21))
"""


def run(arguments: list[str]) -> str:
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_it_works_where_nothing_can_be_kept() -> None:
    """numba finds no place for what comes from no file, and refuses to keep it."""
    plain = PROGRAM.replace("from actors.compiled import compiler", "import numba").replace(
        "@compiler()", "@numba.njit(cache=True)"
    )
    refused = subprocess.run([sys.executable, "-c", plain], capture_output=True, text=True)
    assert "no locator available" in refused.stderr
    assert run(["-c", PROGRAM]) == "42"


def test_it_is_kept_for_the_next_process(tmp_path: Path) -> None:
    module = tmp_path / "doubling.py"
    module.write_text(PROGRAM)
    for _ in range(2):
        assert run([str(module)]) == "42"
    assert list(tmp_path.glob("__pycache__/doubling.twice-*.nbi"))


USER = """
import doubling

from actors.compiled import compiler

@compiler(doubling.__file__)
def twice_and_one(x):
    return doubling.twice(x) + 1

print(twice_and_one(20))
"""


def test_it_is_made_anew_when_what_it_calls_has_changed(tmp_path: Path) -> None:
    called, user = tmp_path / "doubling.py", tmp_path / "using.py"
    called.write_text(PROGRAM.replace("print(twice(21))", ""))
    user.write_text(USER)
    for _ in range(2):
        assert run([str(user)]) == "41"
    called.write_text(called.read_text().replace("2 * x", "30 * x"))
    assert run([str(user)]) == "601"
