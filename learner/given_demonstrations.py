"""The demonstrations that a run was given, with what a person marked: part of its record."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future

from broker_config.codec import decode
from broker_config.errors import StorageError
from broker_config.journal import Appended, JournalReader
from broker_config.messages import TargetsMarked, Trajectory
from broker_config.specs import NetworkSpec
from learner.recorded import TARGET_PREFIX, Demonstrations

DEMONSTRATION_PREFIX = "demonstration/"

Append = Callable[..., Future[tuple[Appended, ...]]]
"""Adds named messages to the journal, all of them or none."""


class GivenDemonstrations:
    """Kept once, when the run begins; whoever resumes it may give the same again."""

    def __init__(
        self, run: str, network: NetworkSpec, journal: JournalReader, append: Append
    ) -> None:
        """Prepares it.

        Args:
            run: Whose they are, for errors.
            network: That learns from them.
            journal: Of the run.
            append: Adds to it.
        """
        self._run = run
        self._network = network
        self._journal = journal
        self._append = append

    def read(self) -> Demonstrations:
        """What was given to `keep`, in any epoch; who made them is not kept."""
        kept = self._journal.entries(prefix=DEMONSTRATION_PREFIX)
        marks = self._journal.entries(prefix=TARGET_PREFIX)
        return Demonstrations(
            tuple(decode(entry.payload, Trajectory) for entry in kept),
            tuple(decode(entry.payload, TargetsMarked) for entry in marks) or None,
        )

    def keep(self, demonstrations: Demonstrations) -> None:
        """Makes the demonstrations, and what a person marked in them, part of the run's record.

        Raises:
            MessageError: The preset's network cannot learn from one of them.
            StorageError: The run has others already, or others were marked.
        """
        given = demonstrations.trajectories
        for item in given:
            item.check_fits(self._network)
        numbers = {item.id: f"{n:06d}" for n, item in enumerate(given)}
        marks = sorted(demonstrations.marks or (), key=lambda mark: numbers[mark.trajectory])
        kept = self.read()
        is_same = [item.id for item in kept.trajectories] == [*numbers]
        if kept.trajectories and not (is_same and list(kept.marks or ()) == marks):
            raise StorageError(
                f"demonstrations: expected the {len(kept.trajectories)} that run {self._run} began "
                "with, and the same targets marked; got others; leave --demonstrations out, or "
                "begin a new run"
            )
        self._append(
            *((f"{DEMONSTRATION_PREFIX}{numbers[item.id]}", item) for item in given),
            *((f"{TARGET_PREFIX}{numbers[mark.trajectory]}", mark) for mark in marks),
        ).result()
