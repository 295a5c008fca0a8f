"""What a report says of a run, in numbers. Times are seconds since the epoch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from broker_config.messages import Command, Rewards, Verdict
from broker_config.preset import Preset
from deploy.evaluation.scores import Score
from deploy.report.attempts import ActorTally, WrongAttempt
from deploy.report.composition import RewardedIteration
from deploy.report.episodes import Episodes, ShownEpisode
from deploy.report.lives import Life
from deploy.report.phases import PhaseSecs


@dataclass(frozen=True)
class Iteration:
    """What an iteration was, once it has led to a policy."""

    number: int
    """From 0."""
    mean_return: float
    success_rate: float
    samples: int
    """Steps of its episodes."""
    lag: int
    """The largest of its episodes'."""
    phases: PhaseSecs
    gradient_secs: float | None
    """What the gradient steps alone took, as the learner's metrics say; None if nobody heard."""


@dataclass(frozen=True)
class Order:
    """What a person asked of the run."""

    unix_secs: float
    command: Command
    process: str | None


@dataclass(frozen=True)
class Recorded:
    """What the recorder was through."""

    away: Sequence[tuple[float, float]]
    """Between two of its lives, seconds since the epoch; what was live then is not recorded."""
    gaps: Mapping[str, int]
    """Live messages that were sent and not recorded, by kind: metrics, view."""
    lost_policies: Sequence[int]
    """Versions whose weights were gone before they could be recorded."""


@dataclass(frozen=True)
class RunRecord:
    """Everything that a report says in numbers. Times are seconds since the epoch."""

    name: str
    preset: Preset
    software: Sequence[str]
    """Versions, in the order in which they owned the run."""
    starts: Sequence[float]
    """Of the owner."""
    first_secs: float
    last_secs: float
    entries: int
    state: str
    """In a word or two."""
    is_complete: bool
    demonstrations: int
    demonstrated_samples: int
    newest_version: int
    episodes: Episodes
    iterations: Sequence[Iteration]
    scores: Sequence[Score]
    shown: Mapping[str, ShownEpisode]
    """By "first", "best", "last"."""
    rewarded: Sequence[RewardedIteration]
    newest_rewards: Rewards | None
    """With the discriminators that gave them."""
    away_secs: float
    lives: Sequence[Life]
    attempts: Mapping[str, ActorTally]
    """By actor."""
    actor_starts: Mapping[str, int]
    wrong: Sequence[WrongAttempt]
    n_wrong: int
    verdicts: Mapping[Verdict, int]
    reseeded: int
    repeated: int
    """Tickets that counted twice: 0, or the journal is wrong."""
    orders: Sequence[Order]
    followers: Sequence[str]
    discriminator_starts: int
    evaluator_starts: int
    recorded: Recorded | None
    """None if there is no recording."""

    @property
    def wall_secs(self) -> float:
        """From the first entry to the last."""
        return self.last_secs - self.first_secs
