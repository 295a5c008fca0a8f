"""The end of a run: its figures and a summary that fits on one screen, made from the journal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from broker_config.errors import StorageError
from broker_config.journal import JournalReader
from broker_config.messages import Trajectory
from deploy.figures import draw_film_strip, draw_learning_curve
from deploy.run_folder import RunFolder
from learner.recorded import accepted_trajectories


@dataclass(frozen=True)
class _Episodes:
    returns: list[float]
    successes: list[bool]
    transitions: int
    last: Trajectory


def summarise(folder: RunFolder, wall_secs: float, is_complete: bool) -> str:
    """Draws the curve and the film strip, writes the summary and returns it.

    Args:
        folder: Of the run.
        wall_secs: How long this part of the run took.
        is_complete: Whether it came to its own end.

    Raises:
        StorageError: There is no episode yet, or the journal cannot be read.
    """
    preset = folder.read_preset()
    episodes = _read(folder)
    per_iteration = preset.schedule.episodes_per_iteration
    draw_learning_curve(
        folder.curve,
        preset.name,
        episodes.returns,
        episodes.successes,
        preset.task.horizon,
        per_iteration,
    )
    number = len(episodes.returns)
    caption = f"{preset.name}: episode {number}, return {episodes.last.return_:.2f}"
    draw_film_strip(folder.film_strip, caption, episodes.last)
    first, last = slice(0, per_iteration), slice(max(0, number - per_iteration), number)
    lines = [
        f"{'Finished' if is_complete else 'Stopped'}: {preset.name} ({preset.source})",
        f"  episodes     {number} of {preset.schedule.episodes}, "
        f"{episodes.transitions} transitions, {wall_secs / 60:.1f} min",
        f"  return       {_mean(episodes.returns[first]):.2f} in the first iteration, "
        f"{_mean(episodes.returns[last]):.2f} in the last",
        f"  success      {_mean(episodes.successes[first]):.0%} in the first iteration, "
        f"{_mean(episodes.successes[last]):.0%} in the last",
        f"  curve        {folder.curve}",
        f"  film strip   {folder.film_strip}",
        f"  journal      {folder.journal}",
        f"  TensorBoard  tensorboard --logdir {folder.tensorboard}",
    ]
    if is_complete:
        lines.append(f"  next         clothbus evaluate {folder.path}")
    else:
        lines.append(f"  next         clothbus run --resume {folder.path}")
    text = "\n".join(lines)
    folder.summary.write_text(text + "\n")
    return text


def _read(folder: RunFolder) -> _Episodes:
    """Sums the parts of interrupted episodes; only one trajectory is in memory at a time."""
    returns: dict[int, float] = {}
    successes: dict[int, bool] = {}
    transitions, last = 0, None
    with JournalReader(folder.journal) as journal:
        for last in accepted_trajectories(journal):
            index = last.ticket.index
            returns[index] = returns.get(index, 0.0) + last.return_
            successes[index] = last.success
            transitions += last.steps
    if last is None:
        raise StorageError(f"{folder.journal}: expected an episode; got none yet; resume the run")
    return _Episodes(list(returns.values()), list(successes.values()), transitions, last)


def _mean(values: list[float] | list[bool]) -> float:
    return float(np.mean(values))
