"""The rows of the fault matrix in their file, and the page that is drawn from them."""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from broker_config.failpoints import Failpoint
from tests.faults.cells import Cell, Fault, Role
from tests.faults.disturbed_run import Healed, Outcome
from tests.faults.ledger import Ledger
from tests.faults.scenes import EVALUATION_EPISODES, LEARNING, Scene

Row = dict[str, Any]


def rows_of(seed: int, outcome: Outcome, ledger: Ledger) -> list[Row]:
    """One row for each fault of a run, and one for the run."""
    faults = [_fault_row(seed, it) for it in outcome.healed]
    run = {"kind": "run", "seed": seed, "faults": len(faults)}
    run |= {
        "hangs": outcome.hangs,
        "wall_secs": round(outcome.wall_secs, 1),
        "settled": ledger.is_settled,
    }
    return [*faults, {**run, **asdict(ledger)}]


def _fault_row(seed: int, healed: Healed) -> Row:
    it = healed.disturbance
    return {
        "kind": "fault",
        "seed": seed,
        "role": it.cell.role,
        "fault": it.cell.fault,
        "failpoint": it.cell.failpoint,
        "process": it.victim.id,
        "at_secs": healed.at_secs,
        "after_trajectories": it.trajectories,
        "recovery_secs": healed.recovery_secs,
    }


def append_rows(path: Path, rows: Sequence[Row]) -> None:
    """Adds the rows of one run: all of them, or none if this process dies meanwhile."""
    partial = path.with_name(path.name + ".partial")
    before = path.read_bytes() if path.exists() else b""
    with partial.open("wb") as file:
        file.write(before + b"".join(json.dumps(row).encode() + b"\n" for row in rows))
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def read_rows(path: Path) -> list[Row]:
    """The rows so far."""
    lines = path.read_text().splitlines() if path.exists() else []
    return [json.loads(line) for line in lines]


def healed_cells(rows: Iterable[Row]) -> list[Cell]:
    """The cell of each fault that was seen to heal before its run ended."""
    return [
        _cell(row) for row in rows if row["kind"] == "fault" and row["recovery_secs"] is not None
    ]


def _cell(row: Row) -> Cell:
    point = Failpoint(row["failpoint"]) if row["failpoint"] else None
    return Cell(Role(row["role"]), Fault(row["fault"]), point)


def draw(scene: Scene, rows: Sequence[Row], actors: int) -> str:
    """The page."""
    runs = [row for row in rows if row["kind"] == "run"]
    recoveries: defaultdict[Cell, list[float]] = defaultdict(list)
    for row in rows:
        if row["kind"] == "fault" and row["recovery_secs"] is not None:
            recoveries[_cell(row)].append(row["recovery_secs"])
    parts = [
        _introduction(scene, rows, runs, actors),
        "## Nothing lost, nothing double",
        _totals(runs),
        "## Recovery after faults at random moments",
        _random_table(scene, recoveries),
        "## Recovery after kills at the failpoints",
        _failpoint_table(scene, recoveries),
        _explanation(),
    ]
    return "\n\n".join(parts) + "\n"


def _introduction(scene: Scene, rows: Sequence[Row], runs: Sequence[Row], actors: int) -> str:
    faults = sum(row["kind"] == "fault" for row in rows)
    equal = sum(row["weights"] == row["undisturbed_weights"] for row in runs)
    settings = " ".join(scene.all_settings)
    made_by = "make faults" if scene is LEARNING else f"make faults-of-{scene.name}"
    page = "fault_matrix" if scene is LEARNING else f"fault_matrix_{scene.name}"
    given = " --demonstrations ..." if scene.demonstrations else ""
    return (
        f"# {scene.title}\n\n"
        f"Made by `{made_by}`, which can be interrupted and goes on where it was; drawn from "
        f"`{page}.jsonl`, one line for each fault and each run.\n\n"
        f"{len(runs)} runs with seeds of their own, {faults} faults, one at a time, each after the "
        f"last had healed. Final weights equal to those of the undisturbed run in one process: "
        f"**{equal} of {len(runs)}**.\n\n"
        f"A run is `clothbus run {scene.preset} --actors {actors} --evaluate "
        f"{EVALUATION_EPISODES} --evaluator-priority normal{given} --set {settings} seed=...`, "
        "with a recorder."
    )


def _totals(runs: Sequence[Row]) -> str:
    def total(name: str) -> int:
        return sum(row[name] for row in runs)

    table = [
        ("steps acted, by the log on the environments' side", total("acted_steps")),
        ("steps journalled", total("journalled_steps")),
        ("steps cut off with a process that died before it had spooled", total("cut_off_steps")),
        ("**steps lost**", total("lost_steps")),
        ("**trajectories lost from a spool**", total("lost_spooled")),
        ("**trajectories double**", total("double_trajectories")),
        ("journal entries", total("journal_entries")),
        ("journal entries recorded, each once and in order", total("recorded_entries")),
        ("policy versions recorded with their weights", total("recorded_snapshots")),
        ("evaluation episodes kept", total("evaluated_lines")),
        ("**evaluation episodes lost**", total("lost_lines")),
        ("**evaluation episodes double**", total("double_lines")),
        ("processes that the supervisor found hanging, and restarted", total("hangs")),
    ]
    return "\n".join(["| counted | sum |", "|---|--:|", *(f"| {n} | {v} |" for n, v in table)])


def _random_table(scene: Scene, recoveries: dict[Cell, list[float]]) -> str:
    lines = [
        "Seconds, p50 / p99 (number of faults).",
        "",
        "| role | " + " | ".join(Fault) + " |",
        "|---|" + "---|" * len(Fault),
    ]
    for role in scene.disturbed:
        cells = [_quantiles(recoveries.get(Cell(role, fault), [])) for fault in Fault]
        lines.append(f"| {role} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _failpoint_table(scene: Scene, recoveries: dict[Cell, list[float]]) -> str:
    lines = [
        "Seconds, p50 / p99 (number of kills). Each point is named for what has just been done.",
        "",
        "| role | failpoint | recovery |",
        "|---|---|---|",
    ]
    lines += [
        f"| {cell.role} | {cell.failpoint} | {_quantiles(recoveries.get(cell, []))} |"
        for cell in scene.failpoint_cells
    ]
    return "\n".join(lines)


def _quantiles(secs: Sequence[float]) -> str:
    if not secs:
        return "none yet"
    p50, p99 = np.percentile(secs, [50, 99])
    return f"{p50:.1f} / {p99:.1f} ({len(secs)})"


def _explanation() -> str:
    return """## How to read it

* *Recovery* is the time from the end of the fault (the kill or SIGTERM is sent; SIGCONT is sent) to
  the next useful act: an actor's next trajectory is journalled; after a fault of the learner, the
  next ticket or trajectory is journalled; after one of the router, the next trajectory; the
  recorder has caught up with the journal (its heartbeats tell, twice a second); the evaluator's
  next episode is in its file; the discriminators' next rewards are journalled. Only acts of the
  new process count. An actor's time includes its wait for a ticket and a whole episode.
* With few faults in a cell, p99 is nearly the longest of them.
* *Cut off* are steps of an episode that its process had not spooled when it died. A simulator plays
  such an episode again from its seed; a robot spools every step before the next.
* *Lost* would be a step of an episode that had been spooled, or whose process lived on, and that is
  not in the journal. At every `kill -9` of an actor its spool is looked at first, and each
  trajectory in it must be in the journal at the end.
* *Double* would be a trajectory in the journal without an episode of its own in the environments'
  log. Attempts that another actor repeated, because the first was stopped for longer than its
  lease, are journalled as spare ones and not learned from.
* An undisturbed run of the same seed computes beside each disturbed one, at the lowest priority.
"""
