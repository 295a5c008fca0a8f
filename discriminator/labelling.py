"""Discriminators driven by a run's journal: which iteration waits, and its rewards. No bus.

What was answered is in the journal with the state that it left behind. So a process that starts
again needs nothing of its own: it follows the journal, and goes on from the newest answer; an
answer that did not get there is found again, bit for bit.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from broker_config.errors import StorageError
from broker_config.messages import (
    DiscriminatorSnapshot,
    IterationAnnounced,
    JournalEntry,
    Rewards,
    Trajectory,
)
from broker_config.preset import Preset
from discriminator.mirror import JournalMirror
from discriminator.real_states import real_states
from discriminator.trainer import DiscriminatorReport, Discriminators, network_weights


class Labeller:
    """Takes journal entries, and has an answer whenever rewards are owed."""

    def __init__(
        self,
        preset: Preset,
        name: str,
        incarnation: str,
        on_step: Callable[[], None] = lambda: None,
    ) -> None:
        """Prepares it.

        Args:
            preset: Of the run, with an [imitation] table.
            name: Of the process, for its messages.
            incarnation: Of the process.
            on_step: Called after every minibatch, to show that an update gets on.
        """
        assert preset.imitation is not None  # who imitates, has a table
        self._preset = preset
        self._target_reward = preset.imitation.target_reward
        self._name = name
        self._incarnation = incarnation
        self._on_step = on_step
        self._mirror = JournalMirror()
        self._discriminators: Discriminators | None = None
        self._state_digest: str | None = None
        """Of the answer that the discriminators' state is that of; None while untrained."""

    @property
    def next_offset(self) -> int:
        """Of the journal entry to be taken next."""
        return self._mirror.next_offset

    @property
    def owed(self) -> IterationAnnounced | None:
        """What waits for rewards, as far as the entries that were taken tell."""
        return self._mirror.owed

    @property
    def answered(self) -> int:
        """The newest iteration whose rewards are in the journal; -1 before there is one."""
        return -1 if self._mirror.given is None else self._mirror.given.iteration

    @property
    def newest(self) -> DiscriminatorSnapshot | None:
        """The discriminators that gave the newest rewards in the journal."""
        return None if self._mirror.given is None else snapshot_of(self._mirror.given)

    @property
    def has_answered_all(self) -> bool:
        """Whether the run's last iteration has its rewards."""
        return self.answered >= self._preset.schedule.iterations - 1

    def take(self, entry: JournalEntry) -> None:
        """Takes the next journal entry.

        Raises:
            StorageError: It is not the next one.
        """
        self._mirror.take(entry)

    def answer(self) -> Rewards:
        """Updates the discriminators on D_G, and labels every sample of it: Algorithm 4.

        Called again before the journal has the answer, it gives the same one.

        Raises:
            MessageError: There are no demonstrations, or no targets where D_T takes part.
            StorageError: Nothing is owed, or the journal lacks what was announced.
        """
        announced = self._mirror.owed
        if announced is None or announced.iteration != self.answered + 1:
            raise StorageError(
                f"rewards: expected iteration {self.answered + 1} to be announced; got "
                f"{'none' if announced is None else announced.iteration}; the journal is damaged"
            )
        discriminators = self._go_back_to_newest_answer()
        states = states_after(self._mirror.generated(announced), announced.samples)
        reports = discriminators.update(states)
        rewards = discriminators.rewards(states)
        state = safetensors.torch.save(discriminators.get_state())
        self._state_digest = hashlib.sha256(state).hexdigest()
        version = announced.iteration + 1
        return Rewards(
            discriminator=self._name,
            incarnation=self._incarnation,
            iteration=announced.iteration,
            digest=announced.digest,
            rewards=rewards.numpy(),
            expert_version=version if "expert" in discriminators.names else None,
            target_version=version if "target" in discriminators.names else None,
            state=state,
            state_digest=self._state_digest,
            numbers=_numbers(reports, rewards),
        )

    def _go_back_to_newest_answer(self) -> Discriminators:
        """The discriminators as the newest rewards in the journal have left them."""
        given = self._mirror.given
        wanted = None if given is None else given.state_digest
        if self._discriminators is None or self._state_digest != wanted:
            mirror = self._mirror
            marks = mirror.marks or None
            real = real_states(mirror.demonstrations, self._target_reward, marks)
            self._discriminators = Discriminators(self._preset, real, self._on_step)
            if given is not None:
                self._discriminators.set_state(state_of(given))
            self._state_digest = wanted
        return self._discriminators


def state_of(rewards: Rewards) -> dict[str, Tensor]:
    """The discriminators' state that rewards carry.

    Raises:
        StorageError: It is no safetensors.
    """
    try:
        return safetensors.torch.load(rewards.state)
    except safetensors.SafetensorError as error:
        raise StorageError(
            f"rewards of iteration {rewards.iteration}: expected the discriminators' state as "
            f"safetensors; got {error}; the journal is damaged"
        ) from error


def snapshot_of(rewards: Rewards) -> DiscriminatorSnapshot:
    """The discriminators that gave rewards, without what only their training needs.

    Raises:
        StorageError: The rewards carry no state.
    """
    weights = safetensors.torch.save(network_weights(state_of(rewards)))
    return DiscriminatorSnapshot(
        rewards.discriminator,
        rewards.iteration,
        rewards.expert_version,
        rewards.target_version,
        weights,
        hashlib.sha256(weights).hexdigest(),
    )


def states_after(trajectories: Sequence[Trajectory], samples: int) -> Tensor:
    """The picture after each sample of D_G, oldest first, u8[samples, H, W, C].

    Args:
        trajectories: That the samples are of, oldest first.
        samples: The newest so many.

    Raises:
        StorageError: They have fewer.
    """
    after = np.concatenate([each.observations[1:] for each in trajectories])
    if len(after) < samples:
        raise StorageError(
            f"D_G: expected {samples} samples; got {len(after)} in {len(trajectories)} "
            "trajectories; the journal is damaged"
        )
    return torch.from_numpy(after[len(after) - samples :])


def _numbers(reports: dict[str, DiscriminatorReport], rewards: Tensor) -> dict[str, float]:
    numbers = {"reward_std": rewards.std(correction=0).item()}
    for name, report in reports.items():
        numbers |= {
            f"{name}_loss": report.loss,
            f"{name}_accuracy": report.accuracy,
            f"{name}_epochs": report.epochs,
        }
    return numbers
