"""`clothbus export`: episodes in formats that others read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console


def export(
    source: Annotated[Path, tyro.conf.Positional],
    /,
    to: Literal["npz", "minari"],
    output: Path,
) -> None:
    """Export episodes for programs that do not know clothbus.

    Args:
        source: A run folder, a recording's folder, or demonstrations.
        to: npz: a compressed file for each episode, and what is known of them as JSON; minari: a
            Minari dataset, from which `clothbus demos import` gives the same episodes again.
        output: The folder to make; in Minari's local storage, its path there is the dataset's name.
    """
    from broker_config.durable import require_new
    from deploy.count_progress import count_progress
    from deploy.exchange.minari_export import export_minari
    from deploy.exchange.minari_format import dataset_id, require_h5py
    from deploy.exchange.npz import export_npz
    from deploy.exchange.source import open_source

    require_new(output)
    if to == "minari":
        require_h5py()
        dataset_id(output)  # refuses a name that Minari would not take
    with count_progress("Reading what there is") as on_entry:
        chosen = open_source(source, on_entry)
    name = ""
    with count_progress("Exporting", chosen.trajectories) as on_trajectory:
        if to == "minari":
            name = f" as {export_minari(chosen, output, on_trajectory)}"
        else:
            export_npz(chosen, output, on_trajectory)
    left_out = f"; {chosen.left_out} behind a gap left out" if chosen.left_out else ""
    Console().print(
        f"{output}: {chosen.trajectories} episodes of {chosen.preset.name}{name}{left_out}",
        highlight=False,
        soft_wrap=True,
    )
