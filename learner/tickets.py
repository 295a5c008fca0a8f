"""Which episode is collected next, by whom, and which attempt of it counts.

The book is a fold over the journal's events `TicketIssued`, `AttemptEnded` and `TicketReseeded`: it
changes only in `apply`, and replaying the journal after a restart gives the same book. Leases are
the one thing that is not journaled: they say who was heard of lately.
"""

from __future__ import annotations

from dataclasses import dataclass, field

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


def derive_seed(run_seed: int, index: int, generation: int, part: int) -> int:
    """The seed of an episode: the same on every machine, different for every argument."""
    words = np.random.SeedSequence([run_seed, index, generation, part]).generate_state(2, np.uint32)
    return (int(words[0]) << 31) ^ int(words[1])


@dataclass
class _TicketState:
    generation: int = 0
    attempts: int = 0
    invalid: int = 0
    lost: int = 0
    steps: int = 0
    complete: bool = False
    parts: list[TrajectoryId] = field(default_factory=list)
    issued: dict[int, TicketIssued] = field(default_factory=dict)
    """By attempt."""


class TicketBook:
    """The state of all tickets of a run.

    Methods that decide (`issue`, `close`, `expire`) return the events that they have applied; the
    caller journals them before it tells anyone.
    """

    def __init__(self, preset: Preset) -> None:
        self._preset = preset
        self._schedule = preset.schedule
        self._tickets: list[_TicketState] = []
        self._first_incomplete = 0
        self._outstanding: dict[tuple[int, int], TicketIssued] = {}
        self._last_request: dict[str, TicketIssued] = {}
        self._verdicts: dict[TrajectoryId, Verdict] = {}
        self._heard_at_secs: dict[tuple[str, str], float] = {}

    # What is known ----------------------------------------------------------------------------

    @property
    def all_complete(self) -> bool:
        """Whether every episode of the run has been collected."""
        return self._first_incomplete == self._schedule.episodes

    def is_complete(self, index: int) -> bool:
        """Whether ticket `index` has all its steps."""
        return index < len(self._tickets) and self._tickets[index].complete

    def parts(self, index: int) -> tuple[TrajectoryId, ...]:
        """The accepted trajectories of a ticket, in order."""
        return tuple(self._tickets[index].parts)

    def verdict(self, trajectory: TrajectoryId) -> Verdict | None:
        """What became of a trajectory, or None if it never arrived."""
        return self._verdicts.get(trajectory)

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
        return events

    def apply(self, event: TicketEvent) -> None:
        """Changes the book by one event, whether it was just decided or is replayed."""
        match event:
            case TicketIssued():
                self._apply_issued(event)
            case AttemptEnded():
                self._apply_ended(event)
            case TicketReseeded(ticket=index, generation=generation):
                state = self._tickets[index]
                state.generation, state.invalid, state.lost = generation, 0, 0

    # Inside -----------------------------------------------------------------------------------

    def _applied(self, event: TicketEvent) -> TicketEvent:
        self.apply(event)
        return event

    def _apply_issued(self, event: TicketIssued) -> None:
        ticket = event.ticket
        while len(self._tickets) <= ticket.index:
            self._tickets.append(_TicketState())
        state = self._tickets[ticket.index]
        state.attempts = ticket.attempt + 1
        state.issued[ticket.attempt] = event
        self._outstanding[ticket.index, ticket.attempt] = event
        self._last_request[event.actor] = event

    def _apply_ended(self, event: AttemptEnded) -> None:
        if event.trajectory is not None:
            self._verdicts[event.trajectory] = event.verdict
        if event.verdict is Verdict.UNASKED:
            return
        state = self._tickets[event.ticket]
        self._outstanding.pop((event.ticket, event.attempt), None)
        match event.verdict:
            case Verdict.ACCEPTED if event.trajectory is not None:
                state.parts.append(event.trajectory)
                state.steps += event.steps
                state.complete = event.is_last_part
                while self.is_complete(self._first_incomplete):
                    self._first_incomplete += 1
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
        if index >= len(self._tickets):
            return []
        state = self._tickets[index]
        hopeless = (
            state.invalid >= INVALID_ATTEMPTS_BEFORE_RESEED
            or state.lost >= LOST_ATTEMPTS_BEFORE_RESEED
        )
        return [self._applied(TicketReseeded(index, state.generation + 1))] if hopeless else []

    def _next_index(self, latest_version: int) -> int | None:
        being_collected = {index for index, _ in self._outstanding}
        for index in range(self._first_incomplete, len(self._tickets)):
            if not self._tickets[index].complete and index not in being_collected:
                return index
        index = len(self._tickets)
        if index == self._schedule.episodes:
            return None
        return index if self._schedule.policy_version(index) <= latest_version else None

    def _make_ticket(self, index: int) -> Ticket:
        state = self._tickets[index] if index < len(self._tickets) else _TicketState()
        exploration = self._preset.exploration
        is_dqn = self._preset.algorithm.method == "dqn"
        return Ticket(
            index=index,
            attempt=state.attempts,
            part=len(state.parts),
            seed=self._seed(index),
            policy_version=self._schedule.policy_version(index),
            steps=self._preset.task.horizon - state.steps,
            epsilon=exploration.epsilon(index) if is_dqn and exploration else 0.0,
        )

    def _judge(self, trajectory: Trajectory) -> tuple[Verdict, str]:
        ticket, steps = trajectory.ticket, trajectory.steps
        state = self._tickets[ticket.index] if ticket.index < len(self._tickets) else _TicketState()
        issued, id_ = state.issued.get(ticket.attempt), trajectory.id
        is_holder = issued and (issued.actor, issued.incarnation) == (id_.actor, id_.incarnation)
        if issued is None or issued.ticket != ticket or not is_holder:
            return Verdict.UNASKED, f"ticket {ticket.index} was not issued like this"
        if trajectory.guard is not None:
            return Verdict.INVALID, f"guard: {trajectory.guard}"
        ended_early = steps < ticket.steps and not trajectory.terminated
        if steps > ticket.steps or (ended_early and not trajectory.interrupted):
            return Verdict.INVALID, f"expected {ticket.steps} steps; got {steps}"
        is_current = (ticket.part, ticket.seed) == (len(state.parts), self._seed(ticket.index))
        if state.complete or not is_current:
            return Verdict.SPARE, "another attempt was complete first"
        return Verdict.ACCEPTED, ""

    def _seed(self, index: int) -> int:
        state = self._tickets[index] if index < len(self._tickets) else _TicketState()
        return derive_seed(self._preset.seed, index, state.generation, len(state.parts))
