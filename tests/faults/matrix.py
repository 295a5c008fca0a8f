"""The fault matrix: `python -m tests.faults.matrix --output docs/fault_matrix.md`.

Disturbs whole runs until every cell has as many faults as are wanted. Each finished run appends its
rows to a file; started again, it goes on from there.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import shutil
import tempfile
from pathlib import Path

from rich.console import Console

from deploy.process import interrupt, on_terminate
from tests.faults.cells import Cell, still_to_do
from tests.faults.disturbed_run import Healed, disturb
from tests.faults.ledger import Undisturbed, settle_run
from tests.faults.scenes import SCENES, Scene
from tests.faults.table import Row, append_rows, draw, healed_cells, read_rows, rows_of

ACTORS = 4
EACH, AT_FAILPOINTS = 10, 3
UNDISTURBED_SECS = 600.0

_console = Console(highlight=False, soft_wrap=True)


def main() -> int:
    on_terminate(interrupt)  # the runs end with us
    options = _arguments()
    rows_path = options.rows or options.output.with_suffix(".jsonl")
    work = options.work or Path(tempfile.mkdtemp(prefix="clothbus-faults-"))
    scene = SCENES[options.scene]
    while missing := _missing(scene, read_rows(rows_path), options.quick):
        rows = read_rows(rows_path)
        seed = 1 + max((row["seed"] for row in rows), default=0)
        _console.print(f"{len(missing)} faults are missing; seed {seed} in {work}")
        new = _one_run(scene, work / f"seed-{seed}", seed, missing)
        append_rows(rows_path, new)
        options.output.write_text(draw(scene, rows + new, ACTORS))
        shutil.rmtree(work / f"seed-{seed}")
    options.output.write_text(draw(scene, read_rows(rows_path), ACTORS))
    _console.print(f"{options.output} is complete")
    with contextlib.suppress(OSError):
        work.rmdir()  # unless a run that is not settled is kept in it
    wrong = [row for row in read_rows(rows_path) if row["kind"] == "run" and not row["settled"]]
    return 1 if wrong else 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Disturbs runs, and draws the fault matrix.")
    parser.add_argument("--output", type=Path, required=True, help="the Markdown page")
    parser.add_argument("--scene", choices=list(SCENES), default="learning", help="which run")
    parser.add_argument("--rows", type=Path, help="the rows; beside the page if not given")
    parser.add_argument("--work", type=Path, help="folder for the runs; temporary if not given")
    parser.add_argument(
        "--quick", action="store_true", help="one fault of each cell, one failpoint of each role"
    )
    return parser.parse_args()


def _missing(scene: Scene, rows: list[Row], quick: bool) -> list[Cell]:
    done = healed_cells(rows)
    dice = random.Random(len(rows))
    each = dict.fromkeys(scene.random_cells, 1 if quick else EACH)
    if not quick:
        each |= dict.fromkeys(scene.failpoint_cells, AT_FAILPOINTS)
        return still_to_do(each, done, dice)
    first_points = {cell.role: cell for cell in reversed(scene.failpoint_cells)}
    return still_to_do(each, done, dice) + [it for it in first_points.values() if it not in done]


def _one_run(scene: Scene, work: Path, seed: int, missing: list[Cell]) -> list[Row]:
    work.mkdir(parents=True, exist_ok=True)
    scene.prepare(work)
    undisturbed = Undisturbed(scene, work, seed)
    with contextlib.closing(undisturbed):
        dice = random.Random(seed)
        outcome = disturb(scene, work / "disturbed", seed, ACTORS, missing, dice, _tell)
        ledger = settle_run(outcome, undisturbed.wait(UNDISTURBED_SECS))
    verdict = "settled" if ledger.is_settled else f"NOT SETTLED: {ledger}"
    _console.print(f"  {len(outcome.healed)} faults in {outcome.wall_secs:.0f} s: {verdict}")
    if not ledger.is_settled:
        _console.print(f"  kept: {shutil.copytree(work, f'{work}-kept')}")
    return rows_of(seed, outcome, ledger)


def _tell(healed: Healed) -> None:
    it = healed.disturbance
    took = (
        "the run ended first" if healed.recovery_secs is None else f"{healed.recovery_secs:.1f} s"
    )
    _console.print(f"  {healed.at_secs:6.1f} s: {it.victim.id}, {it.cell.name}: {took}")


if __name__ == "__main__":
    raise SystemExit(main())
