"""The end of a run: its figures and a summary that fits on one screen, made from the journal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from broker_config.codec import decode
from broker_config.journal import JournalReader
from broker_config.messages import SnapshotTaken, Trajectory
from broker_config.preset import Preset
from deploy.figures import draw_film_strip, draw_learning_curve
from deploy.run_folder import RunFolder
from learner.recorded import accepted_trajectories


@dataclass(frozen=True)
class Summary:
    """What is printed at the end of a run."""

    text: str
    is_complete: bool
    """Whether every episode is in the journal and learned from."""


@dataclass(frozen=True)
class _Episodes:
    returns: list[float]
    successes: list[bool]
    transitions: int
    last: Trajectory


def summarise(folder: RunFolder, wall_secs: float) -> Summary:
    """Draws the curve and the film strip, and writes the summary into the folder.

    Args:
        folder: Of the run.
        wall_secs: How long this part of the run took.

    Raises:
        StorageError: The journal cannot be read.
    """
    preset = folder.read_preset()
    with JournalReader(folder.journal) as journal:
        episodes = _read_episodes(journal)
        is_complete = _learned_episodes(journal) == preset.schedule.episodes
    if episodes is None:
        return Summary(f"Stopped before the first episode: {preset.name}", is_complete=False)
    _draw(folder, preset, episodes)
    text = "\n".join(_lines(folder, preset, episodes, wall_secs, is_complete))
    folder.summary.write_text(text + "\n")
    return Summary(text, is_complete)


def _draw(folder: RunFolder, preset: Preset, episodes: _Episodes) -> None:
    draw_learning_curve(
        folder.curve,
        preset.name,
        episodes.returns,
        episodes.successes,
        preset.task.horizon,
        preset.schedule.episodes_per_iteration,
    )
    number = len(episodes.returns)
    caption = f"{preset.name}: episode {number}, return {episodes.last.return_:.2f}"
    draw_film_strip(folder.film_strip, caption, episodes.last)


def _lines(
    folder: RunFolder, preset: Preset, episodes: _Episodes, wall_secs: float, is_complete: bool
) -> list[str]:
    number, per_iteration = len(episodes.returns), preset.schedule.episodes_per_iteration
    first, last = slice(0, per_iteration), slice(max(0, number - per_iteration), number)
    then = "evaluate" if is_complete else "run --resume"
    return [
        f"{'Finished' if is_complete else 'Stopped'}: {preset.name} ({preset.source})",
        f"  episodes     {number} of {preset.schedule.episodes}, "
        f"{episodes.transitions} transitions, {wall_secs / 60:.1f} min",
        f"  return       {np.mean(episodes.returns[first]):.2f} in the first iteration, "
        f"{np.mean(episodes.returns[last]):.2f} in the last",
        f"  success      {np.mean(episodes.successes[first]):.0%} in the first iteration, "
        f"{np.mean(episodes.successes[last]):.0%} in the last",
        f"  curve        {folder.curve}",
        f"  film strip   {folder.film_strip}",
        f"  journal      {folder.journal}",
        f"  TensorBoard  tensorboard --logdir {folder.tensorboard}",
        f"  next         clothbus {then} {folder.path}",
    ]


def _read_episodes(journal: JournalReader) -> _Episodes | None:
    """Sums the parts of interrupted episodes; only one trajectory is in memory at a time."""
    returns: dict[int, float] = {}
    successes: dict[int, bool] = {}
    transitions, last = 0, None
    for last in accepted_trajectories(journal):
        index = last.ticket.index
        returns[index] = returns.get(index, 0.0) + last.return_
        successes[index] = last.success
        transitions += last.steps
    if last is None:
        return None
    return _Episodes(list(returns.values()), list(successes.values()), transitions, last)


def _learned_episodes(journal: JournalReader) -> int:
    taken = [decode(it.payload, SnapshotTaken) for it in journal.entries(prefix="snapshot/")]
    return max((it.tickets_absorbed for it in taken), default=0)
