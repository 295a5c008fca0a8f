"""Named numbers of a learner over time: for TensorBoard, for the bus and for whoever watches."""

from __future__ import annotations

import time
from pathlib import Path

from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard.writer import FileWriter

from learner.learning import (
    EpisodeAbsorbed,
    IterationLabelled,
    LearningEvent,
    PolicyReady,
    RewardsAwaited,
)


class LearningMetrics:
    """Turns what the learning loop does into numbers, and logs them as TensorBoard scalars.

    Attributes:
        numbers: The newest value of each.
        step: Episodes absorbed: the count against which everything is plotted.
    """

    def __init__(self, folder: Path) -> None:
        """Opens TensorBoard's log folder; a resumed run adds a file to it."""
        self.numbers: dict[str, float] = {}
        self.step = 0
        self._writer = FileWriter(str(folder))
        self._began_secs = time.monotonic()
        self._transitions = 0

    def note(self, event: LearningEvent) -> None:
        """Takes in an event."""
        match event:
            case EpisodeAbsorbed():
                new, self.step = self._of_episode(event), event.index + 1
            case PolicyReady():
                new, self.step = _of_policy(event), event.absorbed
            case IterationLabelled():
                new, self.step = dict(event.rewards.numbers), event.absorbed
            case RewardsAwaited():
                return
        self.numbers.update(new)
        # One event for all: one for each number would cost more than absorbing the episode.
        values = [Summary.Value(tag=name, simple_value=number) for name, number in new.items()]
        self._writer.add_summary(Summary(value=values), self.step)

    def _of_episode(self, episode: EpisodeAbsorbed) -> dict[str, float]:
        self._transitions += episode.steps
        elapsed_secs = max(time.monotonic() - self._began_secs, 1e-9)
        return {
            "episode": episode.index + 1,
            "iteration": episode.iteration + 1,
            "return": episode.return_,
            "success": float(episode.success),
            "steps": episode.steps,
            "policy_lag": episode.policy_lag,
            "transitions_per_sec": self._transitions / elapsed_secs,
        }

    def __enter__(self) -> LearningMetrics:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()


def _of_policy(policy: PolicyReady) -> dict[str, float]:
    numbers: dict[str, float] = {
        "policy_version": policy.snapshot.version,
        "learned_episodes": policy.absorbed,
    }
    if (report := policy.report) is not None:
        numbers |= {
            "loss": report.loss,
            "mean_value": report.mean_value,
            "mean_entropy": report.mean_entropy,
            "bellman_error": report.bellman_error,
            "relative_bellman_error": report.relative_bellman_error,
            "gradient_steps": report.gradient_steps,
            "update_secs": report.secs,
        }
    return numbers
