"""The benchmarks of docs/delivery.md in short forms, each by its own command.

    make bench

They fail where something is lost or double. Figures for the page come from the long forms.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

AGENTLACE = "CLOTHBUS_AGENTLACE"
"""Names an interpreter that has agentlace."""


def run(module: str, out: Path, *arguments: object) -> None:
    command = [sys.executable, "-m", f"tests.benchmarks.{module}", "--out", out, *arguments]
    subprocess.run(list(map(str, command)), check=True)


@pytest.mark.timeout(600)
def test_delivery_beside_ray_and_grpc(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="ray is not installed: pip install clothbus[bench]")
    run("delivery_load", tmp_path / "out", "--episodes", 100, "--rounds", 1)


@pytest.mark.timeout(1200)
def test_what_is_lost(tmp_path: Path) -> None:
    agentlace = os.environ.get(AGENTLACE)
    given = ["--agentlace", agentlace] if agentlace else []
    run("losses", tmp_path / "out", "--messages", 600, "--rate", 40, *given)


@pytest.mark.timeout(600)
def test_a_hundred_light_actors(tmp_path: Path) -> None:
    run("light_actors", tmp_path / "out", "--secs", 30)


@pytest.mark.timeout(600)
def test_recording_beside_training(tmp_path: Path) -> None:
    run("recording_load", tmp_path / "out", "--secs", 20)
