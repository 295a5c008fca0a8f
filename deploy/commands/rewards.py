"""Commands about the rewards that discriminators have given: `clothbus rewards`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from deploy.process import FAILED_CHECK_EXIT

app = tyro.extras.SubcommandApp()


@app.command(name="recompute")
def recompute(source: Annotated[Path, tyro.conf.Positional], /, retrain: bool = False) -> None:
    """Compute a run's rewards again from the discriminators that gave them, and compare.

    The exit code is 1 if any differs by more than rounding, or retraining ends elsewhere.

    Args:
        source: A run folder, or a recording's folder.
        retrain: Train the discriminators again from the demonstrations, too.
    """
    from deploy.count_progress import count_progress
    from deploy.process import use_one_torch_thread
    from deploy.rewards.audit import audit_rewards

    use_one_torch_thread()  # as the discriminators had
    table = Table("iteration", "D_E", "D_T", "samples", "largest difference")
    if retrain:
        table.add_column("trained again")
    is_sound = True
    with count_progress("Iterations") as on_iteration:
        audited = []
        for each in audit_rewards(source, retrained=retrain):
            audited.append(each)
            on_iteration()
    for it in audited:
        row = [it.iteration, it.expert_version, it.target_version, it.samples]
        cells = ["-" if value is None else str(value) for value in row]
        cells.append("none" if it.largest_difference == 0 else f"{it.largest_difference:.2g}")
        if retrain:
            cells.append("the same" if it.same_training else "[red]other weights[/red]")
        table.add_row(*cells)
        is_sound &= it.is_sound and it.same_training is not False
    Console().print(table)
    if not is_sound:
        sys.exit(FAILED_CHECK_EXIT)


@app.command(name="timeline")
def timeline(
    source: Annotated[Path, tyro.conf.Positional],
    /,
    output: Path,
    episodes: tuple[int, ...] = (),
    iteration: int | None = None,
) -> None:
    """Draw what discriminators reward over the steps of episodes, beside their pictures.

    Args:
        source: A run folder, or a recording's folder.
        output: The PNG to write.
        episodes: Which; the first and the last of the run if none is given.
        iteration: Whose discriminators score them; the last ones if not given.
    """
    from deploy.rewards.timeline import draw_timelines, recorded_timelines

    draw_timelines(output, recorded_timelines(source, episodes, iteration))
    Console().print(f"{output}", highlight=False, soft_wrap=True)
