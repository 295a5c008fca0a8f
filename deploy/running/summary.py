"""The end of a run: its figures and a summary that fits on one screen, made from the journal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from broker_config.codec import decode
from broker_config.errors import StorageError
from broker_config.journal import JournalReader
from broker_config.messages import SnapshotTaken, Trajectory
from broker_config.preset import Preset
from deploy.evaluation.scores import Mode, Score, modes_of, read_results, scores_of
from deploy.run_folder import RunFolder
from learner.recorded import accepted_trajectories

if TYPE_CHECKING:
    from deploy.running.figures import ScoredPolicies

# What draws is imported when a run has ended: its beginning shall not wait for matplotlib.


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
    episodes = None
    if folder.journal.exists():  # a learner that is stopped at once has not made it yet
        with JournalReader(folder.journal) as journal:
            episodes = _read_episodes(journal)
    if episodes is None:
        return Summary(f"Stopped before the first episode: {preset.name}", is_complete=False)
    has_learned_all = is_complete(folder)
    scores = scores_of(read_results(folder.evaluation), preset.seed)
    _draw(folder, preset, episodes, scores)
    text = "\n".join(_lines(folder, preset, episodes, scores, wall_secs, has_learned_all))
    folder.summary.write_text(text + "\n")
    return Summary(text, has_learned_all)


def is_complete(folder: RunFolder) -> bool:
    """Whether every episode of a run is in its journal and learned from."""
    try:
        with JournalReader(folder.journal) as journal:
            return _learned_episodes(journal) == folder.read_preset().schedule.episodes
    except StorageError:
        return False  # there is none yet, or the learner says what is wrong with it


def _draw(folder: RunFolder, preset: Preset, episodes: _Episodes, scores: Sequence[Score]) -> None:
    from deploy.running.figures import draw_film_strip, draw_learning_curve

    draw_learning_curve(
        folder.curve,
        preset.name,
        episodes.returns,
        episodes.successes,
        preset.task.horizon,
        preset.schedule.episodes_per_iteration,
        [_scored(preset, scores, mode) for mode in modes_of(preset.algorithm)],
    )
    number = len(episodes.returns)
    caption = f"{preset.name}: episode {number}, return {episodes.last.return_:.2f}"
    draw_film_strip(folder.film_strip, caption, episodes.last)


def _scored(preset: Preset, scores: Sequence[Score], mode: Mode) -> ScoredPolicies:
    from deploy.running.figures import ScoredPolicies

    # One episode has no interval.
    of_mode = [score for score in scores if score.mode == mode and score.episodes > 1]
    return ScoredPolicies(
        mode,
        [preset.schedule.episodes_before(score.version) for score in of_mode],
        [score.mean_return for score in of_mode],
        [score.return_interval for score in of_mode],
        [score.success_rate for score in of_mode],
        [score.success_interval for score in of_mode],
    )


def _last_scores(scores: Sequence[Score]) -> list[str]:
    """One line for each mode in which the newest evaluated policy was scored."""
    newest = max((score.version for score in scores), default=0)
    return [
        f"  evaluated    version {score.version}, {score.mode}, {score.episodes} episodes: return "
        f"{score.mean_return:.2f} ({score.return_interval[0]:.2f} to "
        f"{score.return_interval[1]:.2f}), success {score.success_rate:.0%} "
        f"({score.success_interval[0]:.0%} to {score.success_interval[1]:.0%})"
        for score in scores
        if score.version == newest
    ]


def _lines(
    folder: RunFolder,
    preset: Preset,
    episodes: _Episodes,
    scores: Sequence[Score],
    wall_secs: float,
    is_complete: bool,
) -> list[str]:
    number, per_iteration = len(episodes.returns), preset.schedule.episodes_per_iteration
    first, last = slice(0, per_iteration), slice(max(0, number - per_iteration), number)
    is_offline = folder.offline.exists()
    resume = "train --from SOURCES --output" if is_offline else "run --resume"
    then = "evaluate" if is_complete else resume
    return [
        f"{'Finished' if is_complete else 'Stopped'}: {preset.name} ({preset.source})",
        f"  episodes     {number} of {preset.schedule.episodes}, "
        f"{episodes.transitions} transitions, {wall_secs / 60:.1f} min",
        f"  return       {np.mean(episodes.returns[first]):.2f} in the first iteration, "
        f"{np.mean(episodes.returns[last]):.2f} in the last",
        f"  success      {np.mean(episodes.successes[first]):.0%} in the first iteration, "
        f"{np.mean(episodes.successes[last]):.0%} in the last",
        *_last_scores(scores),
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
