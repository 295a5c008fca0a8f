"""The commands that look at a policy: `attention`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from broker_config.errors import PresetError


def attention(
    folder: Annotated[Path, tyro.conf.Positional],
    /,
    output: Path,
    episode: int = 0,
    steps: int = 8,
) -> None:
    """Draw which parts of each picture speak for the action that the newest policy chooses.

    Args:
        folder: A run folder.
        output: The PNG to write.
        episode: Of the run, whose seed the greedy episode has.
        steps: How many are drawn, at most.
    """
    from deploy.attention import attend, draw_attention
    from deploy.evaluation.policies import newest_policy
    from deploy.run_folder import RunFolder

    if steps < 1 or episode < 0:
        raise PresetError(
            f"attention: expected --steps of 1 or more and --episode of 0 or more; got {steps} and "
            f"{episode}"
        )
    run = RunFolder(folder)
    preset = run.read_preset()
    attended = attend(preset, newest_policy(run, preset), episode, steps)
    draw_attention(output, f"{preset.name}: Grad-CAM of the chosen actions", [("", attended)])
    Console().print(f"{output}: {len(attended)} steps", highlight=False, soft_wrap=True)
