"""Which episode is collected next, by whom, and which attempt of it counts.

The book is a fold over the journal's events `TicketIssued`, `AttemptEnded` and `TicketReseeded`: it
changes only in `apply`, and replaying the journal after a restart gives the same book. Leases are
the one thing that is not journaled: they say who was heard of lately.

In memory is what is still open. What has ended is looked up in the journal when somebody asks for
it, so that a run may have any number of tickets.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from broker_config.messages import (
    AttemptEnded,
    Ticket,
    TicketIssued,
    TicketRequest,
    TicketReseeded,
    Trajectory,
    TrajectoryId,
    Verdict,
)
from broker_config.preset import Preset

TicketEvent = TicketIssued | AttemptEnded | TicketReseeded

INVALID_ATTEMPTS_BEFORE_RESEED = 1
"""Simulators are deterministic: a seed that the guard has ended once would end so each time."""

LOST_ATTEMPTS_BEFORE_RESEED = 10
"""Kills are not the seed's fault, but a seed that always kills the actor must not stop the run."""

LEASE_SECS = 5.0
"""An actor not heard of for this long has lost its tickets; heartbeats come ten times as often."""


@functools.lru_cache(maxsize=256)  # asked for when a ticket is issued and when it is judged
def derive_seed(run_seed: int, index: int, generation: int, part: int) -> int:
    """The seed of an episode: the same on every machine, different for every argument."""
    words = np.random.SeedSequence([run_seed, index, generation, part]).generate_state(2, np.uint32)
    return (int(words[0]) << 31) ^ int(words[1])


def make_ticket(
    preset: Preset,
    index: int,
    *,
    attempt: int = 0,
    generation: int = 0,
    part: int = 0,
    steps_before: int = 0,
) -> Ticket:
    """The ticket of an episode: by default, of its first attempt.

    Args:
        preset: Of the run.
        index: Place of the episode in the run.
        attempt: Counts the issues of this index.
        generation: Counts the seeds that were replaced.
        part: Counts the trajectories already accepted for this index.
        steps_before: Steps of these.
    """
    exploration = preset.exploration
    explores = preset.algorithm.is_epsilon_greedy and exploration is not None
    return Ticket(
        index=index,
        attempt=attempt,
        part=part,
        seed=derive_seed(preset.seed, index, generation, part),
        policy_version=preset.schedule.policy_version(index),
        steps=preset.task.horizon - steps_before,
        epsilon=exploration.epsilon(index) if exploration and explores else 0.0,
    )


@dataclass(slots=True)
class _TicketState:
    generation: int = 0
    attempts: int = 0
    invalid: int = 0
    lost: int = 0
    steps: int = 0
    complete: bool = False
    parts: tuple[TrajectoryId, ...] = ()
    outstanding: int = 0
    """Attempts that are being collected."""


IssuedBefore = Callable[[int, int], TicketIssued | None]
"""Finds, by index and attempt, what was issued and is no longer being collected."""


class TicketBook:
    """The state of all tickets of a run.

    Methods that decide (`issue`, `close`, `expire`) return the events that they have applied; the
    caller journals them before it tells anyone.
    """

    def __init__(self, preset: Preset, issued_before: IssuedBefore) -> None:
        """An empty book.

        Args:
            preset: Of the run.
            issued_before: Looks into the journal.
        """
        self._preset = preset
        self._schedule = preset.schedule
        self._issued_before = issued_before
        self._tickets: dict[int, _TicketState] = {}
        """Of the tickets that were not forgotten."""
        self._next_new = 0
        self._first_incomplete = 0
        self._free: set[int] = set()
        """Tickets to be collected again: incomplete, and nobody is at it."""
        self._outstanding: dict[tuple[int, int], TicketIssued] = {}
        self._last_request: dict[str, TicketIssued] = {}
        self._heard_at_secs: dict[tuple[str, str], float] = {}

    # What is known ----------------------------------------------------------------------------

    @property
    def all_complete(self) -> bool:
        """Whether every episode of the run has been collected."""
        return self._first_incomplete == self._schedule.episodes

    def is_complete(self, index: int) -> bool:
        """Whether ticket `index` has all its steps."""
        if index < self._first_incomplete:
            return True
        return index in self._tickets and self._tickets[index].complete

    def parts(self, index: int) -> tuple[TrajectoryId, ...]:
        """The accepted trajectories of a ticket, in order."""
        return self._tickets[index].parts

    def may_issue(self, latest_version: int) -> bool:
        """Whether there is a ticket to be collected on a policy version that exists."""
        return self._next_index(latest_version) is not None

    def forget_before(self, index: int) -> None:
        """Drops what is kept of the complete tickets before one; nobody asks for their parts."""
        for finished in [it for it in self._tickets if it < min(index, self._first_incomplete)]:
            del self._tickets[finished]

    # Decisions --------------------------------------------------------------------------------

    def issue(
        self, request: TicketRequest, latest_version: int, now_secs: float
    ) -> tuple[Ticket | None, list[TicketEvent]]:
        """Finds a ticket for an actor.

        Args:
            request: Who asks.
            latest_version: Newest policy version that exists.
            now_secs: Monotonic clock.

        Returns:
            The ticket, or None if nothing may be collected now; and the events.
        """
        self.heard(request.actor, request.incarnation, now_secs)
        events = self._end_earlier_incarnations(request) + self._take_back(request)
        index = self._next_index(latest_version)
        if index is None:
            return None, events
        issued = TicketIssued(
            self._make_ticket(index), request.actor, request.incarnation, request.nonce
        )
        return issued.ticket, [*events, self._applied(issued)]

    def repeated(self, request: TicketRequest) -> Ticket | None:
        """The ticket that a request of this nonce has been given before, if it still counts."""
        last = self._last_request.get(request.actor)
        if last is None or last.nonce != request.nonce:
            return None
        is_outstanding = (last.ticket.index, last.ticket.attempt) in self._outstanding
        return last.ticket if is_outstanding else None

    def close(self, trajectory: Trajectory) -> list[TicketEvent]:
        """Judges a trajectory that arrived for the first time."""
        verdict, reason = self._judge(trajectory)
        ticket = trajectory.ticket
        is_last_part = verdict is Verdict.ACCEPTED and (
            trajectory.terminated or trajectory.steps == ticket.steps
        )
        ended = AttemptEnded(
            ticket.index,
            ticket.attempt,
            verdict,
            trajectory.id,
            trajectory.steps,
            is_last_part,
            reason,
        )
        return [self._applied(ended), *self._reseed_if_hopeless(ticket.index)]

    def heard(self, actor: str, incarnation: str, now_secs: float) -> None:
        """Renews the leases of an actor's process."""
        self._heard_at_secs[actor, incarnation] = now_secs

    def expire(self, now_secs: float) -> list[TicketEvent]:
        """Gives up the attempts of actors that were not heard of for `LEASE_SECS`."""
        events: list[TicketEvent] = []
        for issued in list(self._outstanding.values()):
            # An owner that has just restarted has heard of nobody yet: the lease starts now.
            heard_at = self._heard_at_secs.setdefault((issued.actor, issued.incarnation), now_secs)
            if now_secs - heard_at > LEASE_SECS:
                events += self._lose(issued, f"{issued.actor} not heard of for {LEASE_SECS:g} s")
        self._forget_silent(now_secs)
        return events

    def _forget_silent(self, now_secs: float) -> None:
        holders = {(issued.actor, issued.incarnation) for issued in self._outstanding.values()}
        self._heard_at_secs = {
            process: heard_at
            for process, heard_at in self._heard_at_secs.items()
            if process in holders or now_secs - heard_at <= LEASE_SECS
        }

    def apply(self, event: TicketEvent) -> None:
        """Changes the book by one event, whether it was just decided or is replayed."""
        match event:
            case TicketIssued():
                self._apply_issued(event)
            case AttemptEnded():
                self._apply_ended(event)
            case TicketReseeded(ticket=index, generation=generation):
                if (state := self._tickets.get(index)) is not None:
                    state.generation, state.invalid, state.lost = generation, 0, 0

    # Inside -----------------------------------------------------------------------------------

    def _applied(self, event: TicketEvent) -> TicketEvent:
        self.apply(event)
        return event

    def _apply_issued(self, event: TicketIssued) -> None:
        ticket = event.ticket
        state = self._tickets.setdefault(ticket.index, _TicketState())
        state.attempts = ticket.attempt + 1
        state.outstanding += 1
        self._next_new = max(self._next_new, ticket.index + 1)
        self._free.discard(ticket.index)
        self._outstanding[ticket.index, ticket.attempt] = event
        self._last_request[event.actor] = event

    def _apply_ended(self, event: AttemptEnded) -> None:
        if event.verdict is Verdict.UNASKED:
            return
        ended = self._outstanding.pop((event.ticket, event.attempt), None)
        state = self._tickets.get(event.ticket)
        if state is None:
            return  # it came after the ticket was complete and forgotten
        state.outstanding -= ended is not None
        self._count_ended(state, event)
        if state.complete:
            self._free.discard(event.ticket)
            while self.is_complete(self._first_incomplete):
                self._first_incomplete += 1
        elif not state.outstanding:
            self._free.add(event.ticket)

    @staticmethod
    def _count_ended(state: _TicketState, event: AttemptEnded) -> None:
        match event.verdict:
            case Verdict.ACCEPTED if event.trajectory is not None:
                state.parts = (*state.parts, event.trajectory)
                state.steps += event.steps
                state.complete = event.is_last_part
            case Verdict.INVALID:
                state.invalid += 1
            case Verdict.LOST:
                state.lost += 1

    def _end_earlier_incarnations(self, request: TicketRequest) -> list[TicketEvent]:
        """A restarted actor has delivered its spool before it asks: what is left is lost."""
        events: list[TicketEvent] = []
        for issued in list(self._outstanding.values()):
            if issued.actor == request.actor and issued.incarnation != request.incarnation:
                events += self._lose(issued, f"{issued.actor} restarted")
        return events

    def _take_back(self, request: TicketRequest) -> list[TicketEvent]:
        issued = self._outstanding.get(request.gives_back) if request.gives_back else None
        if issued is None or issued.actor != request.actor:
            return []
        return self._lose(issued, f"{issued.actor} cannot play it")

    def _lose(self, issued: TicketIssued, reason: str) -> list[TicketEvent]:
        ticket = issued.ticket
        lost = AttemptEnded(ticket.index, ticket.attempt, Verdict.LOST, None, 0, False, reason)
        return [self._applied(lost), *self._reseed_if_hopeless(ticket.index)]

    def _reseed_if_hopeless(self, index: int) -> list[TicketEvent]:
        state = self._tickets.get(index)
        if state is None or state.complete:
            return []
        hopeless = (
            state.invalid >= INVALID_ATTEMPTS_BEFORE_RESEED
            or state.lost >= LOST_ATTEMPTS_BEFORE_RESEED
        )
        return [self._applied(TicketReseeded(index, state.generation + 1))] if hopeless else []

    def _next_index(self, latest_version: int) -> int | None:
        if self._free:
            return min(self._free)
        index = self._next_new
        if index == self._schedule.episodes:
            return None
        return index if self._schedule.policy_version(index) <= latest_version else None

    def _make_ticket(self, index: int) -> Ticket:
        state = self._tickets.get(index, _TicketState())
        return make_ticket(
            self._preset,
            index,
            attempt=state.attempts,
            generation=state.generation,
            part=len(state.parts),
            steps_before=state.steps,
        )

    def _judge(self, trajectory: Trajectory) -> tuple[Verdict, str]:
        ticket, steps = trajectory.ticket, trajectory.steps
        key, id_ = (ticket.index, ticket.attempt), trajectory.id
        issued = self._outstanding.get(key) or self._issued_before(*key)
        is_holder = issued and (issued.actor, issued.incarnation) == (id_.actor, id_.incarnation)
        if issued is None or issued.ticket != ticket or not is_holder:
            return Verdict.UNASKED, f"ticket {ticket.index} was not issued like this"
        if trajectory.guard is not None:
            return Verdict.INVALID, f"guard: {trajectory.guard}"
        ended_early = steps < ticket.steps and not trajectory.terminated
        if steps > ticket.steps or (ended_early and not trajectory.interrupted):
            return Verdict.INVALID, f"expected {ticket.steps} steps; got {steps}"
        if self.is_complete(ticket.index) or not self._is_current(ticket):
            return Verdict.SPARE, "another attempt was complete first"
        return Verdict.ACCEPTED, ""

    def _is_current(self, ticket: Ticket) -> bool:
        parts = len(self._tickets[ticket.index].parts)
        return (ticket.part, ticket.seed) == (parts, self._seed(ticket.index))

    def _seed(self, index: int) -> int:
        state = self._tickets.get(index, _TicketState())
        return derive_seed(self._preset.seed, index, state.generation, len(state.parts))
