"""Every attempt at every ticket, counted: what went wrong, and whose it was."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from broker_config.messages import AttemptEnded, TicketIssued, TicketReseeded, Verdict

MOST_LISTED: Final = 40
"""Attempts that went wrong, one by one; all are counted."""


@dataclass(frozen=True)
class WrongAttempt:
    """An attempt that did not count."""

    unix_secs: float
    ticket: int
    attempt: int
    actor: str
    verdict: Verdict
    reason: str


@dataclass
class ActorTally:
    """What came of an actor's tickets."""

    issued: int = 0
    steps: int = 0
    """Accepted."""
    verdicts: Counter[Verdict] = field(default_factory=Counter)


class AttemptLog:
    """Folds tickets and their ends; in memory are the open ones and a bounded list.

    Attributes:
        reseeded: Seeds that were replaced.
        wrong: The first of the attempts that did not count.
        n_wrong: How many there were.
    """

    def __init__(self) -> None:
        self._open: dict[tuple[int, int], str] = {}
        self._actors: defaultdict[str, ActorTally] = defaultdict(ActorTally)
        self.reseeded = 0
        self.n_wrong = 0
        self.wrong: list[WrongAttempt] = []

    @property
    def by_actor(self) -> Mapping[str, ActorTally]:
        """In order of names."""
        return dict(sorted(self._actors.items()))

    @property
    def verdicts(self) -> Counter[Verdict]:
        """Of all actors."""
        return sum((tally.verdicts for tally in self._actors.values()), Counter[Verdict]())

    @property
    def still_open(self) -> Sequence[tuple[int, int]]:
        """Ticket and attempt of those that have not ended."""
        return sorted(self._open)

    def issue(self, issued: TicketIssued) -> None:
        """Takes a ticket that was handed out."""
        self._open[issued.ticket.index, issued.ticket.attempt] = issued.actor
        self._actors[issued.actor].issued += 1

    def end(self, ended: AttemptEnded, unix_secs: float) -> None:
        """Takes an end. An attempt that was given up may end again, when its trajectory comes."""
        holder = self._open.pop((ended.ticket, ended.attempt), "")
        actor = ended.trajectory.actor if ended.trajectory else holder
        tally = self._actors[actor]
        tally.verdicts[ended.verdict] += 1
        if ended.verdict is Verdict.ACCEPTED:
            tally.steps += ended.steps
            return
        self.n_wrong += 1
        if len(self.wrong) < MOST_LISTED:
            self.wrong.append(
                WrongAttempt(
                    unix_secs, ended.ticket, ended.attempt, actor, ended.verdict, ended.reason
                )
            )

    def reseed(self, _: TicketReseeded) -> None:
        """Takes a seed that was replaced."""
        self.reseeded += 1
