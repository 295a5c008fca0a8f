"""Announces iterations to the discriminators and takes the rewards they give; no bus.

The journal is all its state: `announced/<iteration>` and `rewards/<iteration>`, each there at most
once, so that either side may die and ask or answer again.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future

from broker_config.codec import decode
from broker_config.errors import MessageError
from broker_config.journal import Appended, JournalReader
from broker_config.messages import IterationAnnounced, Rewards, RewardsAck

Append = Callable[[str, object], Future[tuple[Appended, ...]]]
"""Adds an entry of this name with this message, or its bytes, to the journal."""


class RewardDesk:
    """One iteration after the other gets its rewards, once and for all. Thread-safe."""

    def __init__(
        self,
        journal: JournalReader,
        append: Append,
        owner_epoch: int,
        note_change: Callable[[], None],
    ) -> None:
        """Prepares it.

        Args:
            journal: Of the run.
            append: Adds to it.
            owner_epoch: For acks.
            note_change: Told when rewards are in the journal.
        """
        self._journal = journal
        self._append = append
        self._owner_epoch = owner_epoch
        self._note_change = note_change

    def announce(self, announced: IterationAnnounced) -> None:
        """Journals that an iteration waits for rewards; doing it twice changes nothing.

        Raises:
            MessageError: Another D_G was announced under this iteration.
        """
        name = f"announced/{announced.iteration}"
        (appended,) = self._append(name, announced).result()
        if appended.is_new:
            return
        before = self._announced(announced.iteration)
        if before != announced:
            raise MessageError(
                f"iteration {announced.iteration}: expected D_G {_digest_of(before)}, as it was "
                f"announced; got {announced.digest}; the run folder is of another run or damaged"
            )

    def receive(self, rewards: Rewards, payload: bytes) -> Future[RewardsAck]:
        """Takes an iteration's rewards; the ack is there once they are durable.

        Args:
            rewards: What a discriminator service gives.
            payload: The same as it was sent, which is what is kept.

        Raises:
            MessageError: They are of an iteration or a D_G that was not announced, or too few.
        """
        announced = self._announced(rewards.iteration)
        if announced is None or announced.digest != rewards.digest:
            raise MessageError(
                f"rewards of iteration {rewards.iteration}: expected D_G {_digest_of(announced)}, "
                f"as it was announced; got {rewards.digest}; follow this run's journal"
            )
        if len(rewards.rewards) != announced.samples:
            raise MessageError(
                f"rewards of iteration {rewards.iteration}: expected {announced.samples}, one for "
                f"each sample; got {len(rewards.rewards)}"
            )
        ack: Future[RewardsAck] = Future()

        def acknowledge(done: Future[tuple[Appended, ...]]) -> None:
            try:
                (stored,) = done.result()
                if not stored.is_new:
                    self._require_same(rewards)
            except Exception as error:  # whoever asked must hear of it
                ack.set_exception(error)
                return
            self._note_change()
            is_duplicate = not stored.is_new
            ack.set_result(
                RewardsAck(rewards.iteration, self._owner_epoch, stored.offset, is_duplicate)
            )

        self._append(f"rewards/{rewards.iteration}", payload).add_done_callback(acknowledge)
        return ack

    def rewards_of(self, announced: IterationAnnounced) -> Rewards | None:
        """The rewards of an announced iteration, once they are durable.

        Raises:
            MessageError: The journal has some of another D_G.
        """
        given = self._given(announced.iteration)
        if given is not None and given.digest != announced.digest:
            raise MessageError(
                f"rewards of iteration {announced.iteration}: expected those of D_G "
                f"{announced.digest}; got {given.digest}; the journal is damaged"
            )
        return given

    def _announced(self, iteration: int) -> IterationAnnounced | None:
        entry = self._journal.find(f"announced/{iteration}")
        return None if entry is None else decode(entry.payload, IterationAnnounced)

    def _given(self, iteration: int) -> Rewards | None:
        entry = self._journal.find(f"rewards/{iteration}")
        return None if entry is None else decode(entry.payload, Rewards)

    def _require_same(self, rewards: Rewards) -> None:
        before = self._given(rewards.iteration)
        if before is not None and not before.is_same_as(rewards):
            raise MessageError(
                f"rewards of iteration {rewards.iteration}: expected those that it was given by "
                f"{before.discriminator}, {before.incarnation}; got others; a run has one "
                "discriminator service, and one machine gives the same rewards again"
            )


def _digest_of(announced: IterationAnnounced | None) -> str:
    return "none" if announced is None else announced.digest
