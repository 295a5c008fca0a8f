"""The discriminators on the bus: they follow the journal, and give each iteration its rewards."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import TypeVar

from broker_config.bus import Bus, Publisher
from broker_config.errors import OwnerUnreachable, PresetError, StorageError
from broker_config.failpoints import Failpoint, reach
from broker_config.heart import Heart, Pulse
from broker_config.joining import RETRY_SECS, StopRequested, attach, insist
from broker_config.messages import (
    JournalBatch,
    JournalRequest,
    Metrics,
    Rewards,
    RewardsAck,
    Role,
)
from broker_config.preset import Preset, preset_from_json
from discriminator.labelling import Labeller

_log = logging.getLogger(__name__)

BATCH_BYTES = 4 << 20
POLL_SECS = 0.05
"""Between two questions when there is nothing new."""

ASK_TIMEOUT_SECS = 5.0
_ROLE: Role = "discriminator"

R = TypeVar("R")


class DiscriminatorService:
    """One discriminator process; `run` returns when the run is over, or on `stop`.

    It keeps nothing of its own: killed at any moment, the next one follows the journal from its
    beginning, and answers what waits.

    Attributes:
        state: What it is doing, as its heartbeats say.
    """

    def __init__(self, bus: Bus, name: str, incarnation: str) -> None:
        """Prepares it.

        Args:
            bus: Its place on the bus, under the same name.
            name: Of this process.
            incarnation: Of this process; another for every start.
        """
        self._bus = bus
        self._name = name
        self._incarnation = incarnation
        self._pulse = Pulse()
        self._stop = threading.Event()
        self._owner_epoch = -1
        self._is_over = False
        """The owner takes nothing more: the run was stopped."""
        self._made: Rewards | None = None
        """The newest that were made here, until they are delivered."""
        self._published = -1
        """Iteration of the newest snapshot that was published."""
        self._numbers: dict[str, float] = {}
        self.state = "attaching"

    def stop(self) -> None:
        """Asks the service to leave; safe in a signal handler."""
        self._stop.set()

    def run(self) -> bool:
        """Gives rewards.

        Returns:
            Whether the run is over; False after `stop`.

        Raises:
            AttachRefused: The owner's versions differ, or the run has a discriminator service.
            PresetError: The run does not imitate.
            MessageError: The demonstrations show nothing that D_E or D_T could learn from.
            Refused: The owner has other rewards for the iteration.
            StorageError: The journal is damaged or another run's.
        """
        try:
            preset = self._attach(None)
            with self._heart():
                self._give_rewards(preset)
        except StopRequested:
            return False
        return True

    def _heart(self) -> Heart:
        return Heart(
            self._bus,
            _ROLE,
            self._name,
            self._incarnation,
            lambda: (self.state, dict(self._numbers)),
            self._pulse,
        )

    def _give_rewards(self, preset: Preset) -> None:
        if not preset.has_discriminators:
            raise PresetError(
                f"{preset.name}: expected a run with an [imitation] table whose rewards "
                "discriminators give; got one without; no discriminator is needed"
            )
        labeller = Labeller(preset, self._name, self._incarnation, self._on_step)
        snapshots = self._bus.latest_publisher(self._bus.keys.discriminators)
        metrics = self._bus.publisher(self._bus.keys.metrics(_ROLE, self._name))
        while not (labeller.has_answered_all or self._is_over):
            if not self._follow_once(labeller, preset):
                continue
            self._publish_newest(labeller, snapshots)
            if labeller.owed is not None and not self._is_over:
                reach(Failpoint.ANNOUNCEMENT_FOLLOWED)
                self._answer(labeller, metrics)
        self._publish_newest(labeller, snapshots)
        self.state = "finished"

    # The journal ------------------------------------------------------------------------------

    def _follow_once(self, labeller: Labeller, preset: Preset) -> bool:
        """Takes the next entries; returns whether that was all that there are."""
        batch = self._insist(lambda: self._ask_for_entries(labeller.next_offset))
        if batch.end_offset < labeller.next_offset:
            raise StorageError(
                f"journal: expected at least the {labeller.next_offset} entries that were "
                f"followed; got {batch.end_offset}; it is another run's, or has lost its end: "
                "start this process again"
            )
        if batch.owner_epoch != self._owner_epoch:
            self._attach(preset)
        for entry in batch.entries:
            labeller.take(entry)
        has_all = labeller.next_offset >= batch.end_offset
        self._is_over = has_all and batch.is_final
        self.state = "following" if has_all else "catching up"
        self._numbers |= {"iteration": labeller.answered + 1, "offset": labeller.next_offset}
        if has_all and labeller.owed is None and self._stop.wait(POLL_SECS):
            raise StopRequested
        return has_all

    def _ask_for_entries(self, offset: int) -> JournalBatch:
        request = JournalRequest(_ROLE, self._name, self._incarnation, offset, offset, BATCH_BYTES)
        key = self._bus.keys.journal(_ROLE, self._name)
        return self._bus.ask(key, request, JournalBatch, timeout_secs=ASK_TIMEOUT_SECS)

    # An answer --------------------------------------------------------------------------------

    def _publish_newest(self, labeller: Labeller, snapshots: Publisher) -> None:
        """What the journal has; also what was answered before this process was started."""
        if labeller.answered > self._published and (newest := labeller.newest) is not None:
            snapshots.put(newest)
            self._published = labeller.answered
            reach(Failpoint.DISCRIMINATORS_PUBLISHED)

    def _answer(self, labeller: Labeller, metrics: Publisher) -> None:
        rewards = self._rewards_owed(labeller)
        self.state = f"delivering rewards of iteration {rewards.iteration}"
        key = self._bus.keys.rewards(self._name)
        try:
            self._bus.ask(key, rewards, RewardsAck, timeout_secs=ASK_TIMEOUT_SECS)
        except OwnerUnreachable as error:
            # Whether they are still owed, the journal says.
            self._note_silence()
            _log.debug("%s", error)
            if self._stop.wait(RETRY_SECS):
                raise StopRequested from error
            return
        reach(Failpoint.REWARDS_ACKED)
        metrics.put(self._metrics_of(rewards))
        self._numbers |= rewards.numbers
        _log.info("Iteration %d has its rewards: %s", rewards.iteration, _described(rewards))

    def _rewards_owed(self, labeller: Labeller) -> Rewards:
        """Made once, however often they have to be delivered."""
        if self._made is None or self._made.iteration != labeller.answered + 1:
            self.state = f"updating for iteration {labeller.answered + 1}"
            self._made = labeller.answer()
            reach(Failpoint.REWARDS_MADE)
        return self._made

    def _metrics_of(self, rewards: Rewards) -> Metrics:
        iteration = rewards.iteration
        return Metrics(
            _ROLE, self._name, self._incarnation, iteration, iteration + 1, rewards.numbers
        )

    # The owner --------------------------------------------------------------------------------

    def _attach(self, preset: Preset | None) -> Preset:
        welcome = self._insist(
            lambda: attach(self._bus, _ROLE, self._name, self._incarnation, preset, self._stop.wait)
        )
        self._owner_epoch = welcome.owner_epoch
        return preset_from_json(welcome.preset_json)

    def _insist(self, ask: Callable[[], R]) -> R:
        return insist(ask, self._stop, self._pulse.beat, self._note_silence)

    def _on_step(self) -> None:
        """An update gets on; asked to leave, what it has trained goes with the process."""
        self._pulse.beat()
        if self._stop.is_set():
            raise StopRequested

    def _note_silence(self) -> None:
        self.state = "waiting for the owner"


def _described(rewards: Rewards) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in rewards.numbers.items())
