"""Rewards computed again from the discriminators that gave them, and compared.

Each reward names its versions, and the journal holds the state of both. With `retrained` the
discriminators are also trained again, from the demonstrations on: that the state itself is what
Algorithm 4 makes of the run's record.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from broker_config.codec import decode
from broker_config.errors import StorageError
from broker_config.messages import IterationAnnounced, JournalEntry, Rewards, RunStarted
from broker_config.preset import Preset, preset_from_json
from deploy.offline.recorded_episodes import journal_entries, source_paths
from discriminator.labelling import Labeller, snapshot_of, states_after
from discriminator.mirror import JournalMirror
from discriminator.stored import StoredDiscriminators

MOST_ROUNDING: Final = 1e-4
"""Of rewards of about 1, computed on another type of processor."""


@dataclass(frozen=True)
class AuditedIteration:
    """One iteration's rewards, as they were given and as they come out again."""

    iteration: int
    expert_version: int | None
    target_version: int | None
    samples: int
    largest_difference: float
    """Between a reward that was given and the same one computed again."""
    same_training: bool | None
    """Whether training again leads to the same state, bit for bit; None if it was not tried."""

    @property
    def is_sound(self) -> bool:
        """Whether the rewards are those of the versions that they name."""
        return self.largest_difference <= MOST_ROUNDING


def audit_rewards(source: Path, *, retrained: bool = False) -> Iterator[AuditedIteration]:
    """Computes every reward of a run again, one iteration in memory.

    Args:
        source: A run folder, or a recording's folder.
        retrained: Train the discriminators again, too.

    Raises:
        StorageError: The source is damaged, or no discriminators have given rewards in it.
    """
    (source,) = source_paths([source])
    audit: _Audit | None = None
    found = False
    for entry in journal_entries(source):
        if audit is None and entry.name.startswith("run/"):
            preset = preset_from_json(decode(entry.payload, RunStarted).preset_json)
            if preset.has_discriminators:
                audit = _Audit(preset, retrained=retrained)
        if audit is not None and (audited := audit.take(entry)) is not None:
            found = True
            yield audited
    if not found:
        raise StorageError(
            f"{source}: expected a run in which discriminators have given rewards; got none; name "
            "one of a preset with [imitation]"
        )


class _Audit:
    """Follows a journal as the discriminators did."""

    def __init__(self, preset: Preset, *, retrained: bool) -> None:
        self._preset = preset
        self._mirror = JournalMirror()
        self._labeller = Labeller(preset, "audit", "audit") if retrained else None

    def take(self, entry: JournalEntry) -> AuditedIteration | None:
        given_before = self._mirror.given
        self._mirror.take(entry)
        audited = None
        if (given := self._mirror.given) is not None and given is not given_before:
            # Before the labeller knows the answer: it still owes one of its own.
            audited = self._compare(given, self._mirror.announced)
        if self._labeller is not None:
            self._labeller.take(entry)
        return audited

    def _compare(self, given: Rewards, announced: IterationAnnounced | None) -> AuditedIteration:
        if announced is None or announced.iteration != given.iteration:
            raise StorageError(
                f"rewards of iteration {given.iteration}: expected them after their announcement; "
                "got them without; the journal is damaged"
            )
        states = states_after(self._mirror.generated(announced), announced.samples)
        stored = StoredDiscriminators(self._preset, snapshot_of(given).weights)
        again = stored.rewards(states).numpy()
        same_training = None
        if self._labeller is not None:
            same_training = self._labeller.answer().state_digest == given.state_digest
        return AuditedIteration(
            given.iteration,
            given.expert_version,
            given.target_version,
            announced.samples,
            float(np.abs(again - given.rewards).max()),
            same_training,
        )
