"""What a recorder heard of a run's live traffic, and what it was through itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Final

from broker_config.messages import Metrics, Presence, RecorderStarted, RecordingGap
from broker_config.preset import Preset
from deploy.evaluation.scores import Mode, Score, modes_of
from deploy.report.lives import LifeBook
from deploy.report.record import Recorded


class LiveLog:
    """Folds presence, metrics and gaps; signs of life go to a book of lives.

    Attributes:
        gradient_secs: What the gradient steps of an iteration's updates took, by iteration.
    """

    def __init__(self, preset: Preset, lives: LifeBook) -> None:
        self._preset = preset
        self._lives = lives
        self._recorder: str | None = None
        self._last_secs = 0.0
        self._away: list[tuple[float, float]] = []
        self._gaps: Counter[str] = Counter()
        self._lost_policies: list[int] = []
        self._newest_update = 0.0
        self._scores: dict[tuple[int, Mode], Score] = {}
        self.gradient_secs: dict[int, float] = {}

    @property
    def recorded(self) -> Recorded | None:
        """None if no recorder was there."""
        if self._recorder is None:
            return None
        return Recorded(self._away, dict(self._gaps), self._lost_policies)

    @property
    def scores(self) -> list[Score]:
        """What evaluators have announced, by version and mode."""
        return [score for _, score in sorted(self._scores.items())]

    def take(self, message: object, secs: float) -> None:
        """Takes the next message, and when it was written."""
        match message:
            case RecorderStarted():
                self._start(message, secs)
            case Presence():
                self._lives.presence(message, secs)
            case RecordingGap():
                self._note_gap(message)
            case Metrics():
                self._lives.sign(message.role, message.id, message.incarnation, secs)
                self._note_numbers(message)
            case _:
                pass
        self._last_secs = secs
        self._lives.heard_until(secs)

    def _start(self, started: RecorderStarted, secs: float) -> None:
        if self._recorder not in (None, started.incarnation):
            self._away.append((self._last_secs, secs))
            self._lives.recorder_started()
        self._recorder = started.incarnation

    def _note_gap(self, gap: RecordingGap) -> None:
        kind, _, rest = gap.key.partition("/")
        if kind == "policy":
            self._lost_policies.append(int(rest))
        else:
            self._gaps[kind] += gap.missing

    def _note_numbers(self, metrics: Metrics) -> None:
        numbers, version = metrics.numbers, metrics.numbers.get("policy_version", 0.0)
        if metrics.role == "owner" and version > self._newest_update and "update_secs" in numbers:
            self._newest_update = version
            schedule = self._preset.schedule
            iteration = (schedule.episodes_before(int(version)) - 1) // (
                schedule.episodes_per_iteration
            )
            total = self.gradient_secs.get(iteration, 0.0) + numbers["update_secs"]
            self.gradient_secs[iteration] = total
        if metrics.role == "evaluator" and "version" in numbers:
            for mode in modes_of(self._preset.algorithm):
                if f"{mode}/return" in numbers:
                    score = _announced_score(int(numbers["version"]), mode, numbers)
                    self._scores[score.version, mode] = score


def _announced_score(version: int, mode: Mode, numbers: Mapping[str, float]) -> Score:
    """The inverse of `Score.numbers`; the single episodes are not announced."""
    of = {name: numbers[f"{mode}/{name}"] for name in _SCORE_NUMBERS}
    return Score(
        version,
        mode,
        int(of["episodes"]),
        of["return"],
        (of["return_low"], of["return_high"]),
        of["success"],
        (of["success_low"], of["success_high"]),
        returns=(),
    )


_SCORE_NUMBERS: Final = (
    *("return", "return_low", "return_high", "success", "success_low", "success_high"),
    "episodes",
)
