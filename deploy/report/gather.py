"""A run's record, folded into what its report says; one message in memory at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from broker_config.codec import decode_any
from broker_config.messages import (
    AttemptEnded,
    Command,
    Control,
    FollowerJoined,
    IterationAnnounced,
    JournalEntry,
    Rewards,
    RunStarted,
    SnapshotTaken,
    TicketIssued,
    TicketReseeded,
    Trajectory,
    Verdict,
)
from broker_config.preset import Preset
from broker_config.recording.recording import RecordedMessage
from deploy.evaluation.scores import Score
from deploy.report.attempts import AttemptLog
from deploy.report.composition import CompositionLog
from deploy.report.episodes import EpisodeLog, Episodes
from deploy.report.heard import LiveLog
from deploy.report.lives import LifeBook
from deploy.report.phases import PhaseClock
from deploy.report.record import Iteration, Order, RunRecord
from deploy.report.sources import RunSource

_MOST_CONTROLS: Final = 40
_TOLD_EVERY: Final = 50


def gather(source: RunSource, on_entry: Callable[[int], None] = lambda _: None) -> RunRecord:
    """Reads a run's journal once, then what was recorded of its live traffic.

    Args:
        source: Of the run.
        on_entry: Is told now and then how many entries have been read.

    Raises:
        StorageError: The journal or the recording cannot be read.
        DecodeError: It holds something else.
    """
    fold = _Fold(source.preset)
    for number, entry in enumerate(source.entries(), 1):
        fold.take(entry)
        if number % _TOLD_EVERY == 0:
            on_entry(number)
    for message in source.live():
        fold.hear(message)
    return fold.record(source.evaluations())


class _Fold:
    """The record so far."""

    def __init__(self, preset: Preset) -> None:
        self._preset = preset
        self._name = ""
        self._software: list[str] = []
        self._starts: list[float] = []
        self._first_secs = self._last_secs = 0.0
        self._entries = 0
        self._demonstrations = self._demonstrated_samples = 0
        self._newest_version, self._absorbed = 0, 0
        self._episodes = EpisodeLog(preset.schedule)
        self._attempts = AttemptLog()
        self._clock = PhaseClock(preset.schedule)
        self._composition = CompositionLog(preset)
        self._lives = LifeBook()
        self._orders: list[Order] = []
        self._is_stopping = self._is_paused = False
        self._followers: dict[str, None] = {}
        self._heard = LiveLog(preset, self._lives)

    # The journal ------------------------------------------------------------------------------

    def take(self, entry: JournalEntry) -> None:
        """Takes the next entry of the journal."""
        message, secs = decode_any(entry.payload), entry.unix_secs
        if isinstance(message, RunStarted):
            self._close_owners_life()
        if not self._entries:
            self._first_secs = secs
        self._last_secs = max(self._last_secs, secs)
        self._entries += 1
        self._clock.tick(secs, starts_owner=isinstance(message, RunStarted))
        match message:
            case RunStarted():
                self._start(message, secs)
            case Trajectory() if entry.name.startswith("demonstration/"):
                self._demonstrations += 1
                self._demonstrated_samples += message.steps
            case Trajectory(id=id_):
                self._lives.sign("actor", id_.actor, id_.incarnation, secs)
                self._episodes.take(message)
            case TicketIssued():
                self._lives.sign("actor", message.actor, message.incarnation, secs)
                self._attempts.issue(message)
            case AttemptEnded():
                self._end(message, secs)
            case TicketReseeded():
                self._attempts.reseed(message)
            case _:
                self._take_of_learner(message, secs)

    def _take_of_learner(self, message: object, secs: float) -> None:
        match message:
            case IterationAnnounced():
                self._composition.announce(message)
                self._clock.announced()
            case Rewards():
                who = message.discriminator, message.incarnation
                self._lives.sign("discriminator", *who, secs)
                self._composition.reward(message)
                self._clock.rewarded()
            case SnapshotTaken():
                self._newest_version = max(self._newest_version, message.version)
                self._absorbed = max(self._absorbed, message.tickets_absorbed)
                self._clock.policy_known(message.version)
            case Control():
                self._obey(Order(secs, message.command, message.process))
            case FollowerJoined():
                self._followers[message.id] = None
            case _:
                pass  # an iteration's mean is told from its episodes

    def _start(self, started: RunStarted, secs: float) -> None:
        self._name = started.run
        self._starts.append(secs)
        if started.software_version not in self._software[-1:]:
            self._software.append(started.software_version)
        self._lives.sign("owner", "learner", f"epoch-{started.owner_epoch}", secs)
        self._is_stopping = False

    def _end(self, ended: AttemptEnded, secs: float) -> None:
        self._attempts.end(ended, secs)
        if (trajectory := self._episodes.end(ended)) is not None:
            self._composition.take(trajectory)
        if ended.verdict is Verdict.ACCEPTED and ended.is_last_part:
            self._clock.episode_ended(ended.ticket)

    def _obey(self, order: Order) -> None:
        self._is_paused = {Command.PAUSE: True, Command.RESUME: False}.get(
            order.command, self._is_paused
        )
        self._is_stopping = self._is_stopping or order.command is Command.STOP
        if len(self._orders) < _MOST_CONTROLS:
            self._orders.append(order)

    # The live traffic -------------------------------------------------------------------------

    def hear(self, message: RecordedMessage) -> None:
        """Takes the next message of a recording that is not of the journal."""
        self._heard.take(message.decode(), message.log_time_ns / 1e9)

    # The result -------------------------------------------------------------------------------

    def record(self, evaluations: list[Score] | None) -> RunRecord:
        """What was folded, with the scores of an evaluation if its episodes are there."""
        self._close_owners_life()
        episodes = self._episodes.episodes
        shown = {
            name: it
            for name in ("first", "best", "last")
            if (it := getattr(self._episodes, name)) is not None
        }
        attempts = self._attempts
        return RunRecord(
            name=self._name,
            preset=self._preset,
            software=self._software,
            starts=self._starts,
            first_secs=self._first_secs,
            last_secs=self._last_secs,
            entries=self._entries,
            state=self._state,
            is_complete=self._is_complete,
            demonstrations=self._demonstrations,
            demonstrated_samples=self._demonstrated_samples,
            newest_version=self._newest_version,
            episodes=episodes,
            iterations=self._iterations(episodes),
            scores=self._heard.scores if evaluations is None else evaluations,
            shown=shown,
            rewarded=self._composition.rows,
            newest_rewards=self._composition.newest,
            away_secs=self._clock.away_secs,
            lives=self._lives.lives,
            attempts=attempts.by_actor,
            actor_starts={it: self._lives.starts_of(("actor", it)) for it in attempts.by_actor},
            wrong=attempts.wrong,
            n_wrong=attempts.n_wrong,
            verdicts=attempts.verdicts,
            reseeded=attempts.reseeded,
            repeated=self._episodes.repeated,
            orders=self._orders,
            followers=list(self._followers),
            discriminator_starts=self._lives.starts("discriminator"),
            evaluator_starts=self._lives.starts("evaluator"),
            recorded=self._heard.recorded,
        )

    def _close_owners_life(self) -> None:
        """The newest owner has written the last entry so far."""
        if self._starts:
            self._lives.sign("owner", "learner", f"epoch-{len(self._starts)}", self._last_secs)

    @property
    def _is_complete(self) -> bool:
        return self._absorbed == self._preset.schedule.episodes

    @property
    def _state(self) -> str:
        if self._is_complete:
            return "complete"
        if self._is_stopping:
            return "stopped"
        return "paused" if self._is_paused else "not finished"

    def _iterations(self, episodes: Episodes) -> list[Iteration]:
        per_iteration = self._preset.schedule.episodes_per_iteration
        found = []
        for number, phases in sorted(self._clock.phases.items()):
            first = number * per_iteration
            its = episodes.of(range(first, first + per_iteration))
            found.append(
                Iteration(
                    number,
                    float(np.mean(episodes.returns[its])),
                    float(np.mean(episodes.successes[its])),
                    int(np.sum(episodes.steps[its])),
                    int(np.max(episodes.lags[its])),
                    phases,
                    self._heard.gradient_secs.get(number),
                )
            )
        return found
