"""Tickets: what an actor is to do next."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from broker_config.messages.rules import require, require_count, require_id


@dataclass(frozen=True)
class Ticket:
    """Collect one episode with this seed on exactly this policy version."""

    index: int
    """Place of the episode in the run; the memory is ordered by it, never by arrival."""
    attempt: int
    """Counts the issues of this index."""
    part: int
    """Counts the trajectories already accepted for this index: 0 except after a robot's crash."""
    seed: int
    """Seeds the environment and the policy."""
    policy_version: int
    steps: int
    """Steps to collect: the horizon, or what an interrupted attempt left of it."""
    epsilon: float
    """Probability of a random action; 0 for policies that sample by themselves."""

    def __post_init__(self) -> None:
        for name in ("index", "attempt", "part", "seed", "policy_version"):
            require_count(f"ticket.{name}", getattr(self, name))
        require(self.steps >= 1, "ticket.steps", "at least 1", self.steps)
        require(0 <= self.epsilon <= 1, "ticket.epsilon", "a number in [0, 1]", self.epsilon)


@dataclass(frozen=True)
class TicketRequest:
    """An actor asks what to do next; the same nonce always gets the same answer."""

    actor: str
    incarnation: str
    nonce: str
    gives_back: tuple[int, int] | None = None
    """Index and attempt of a ticket that the actor cannot play."""

    def __post_init__(self) -> None:
        require_id("ticket_request.actor", self.actor)
        require_id("ticket_request.incarnation", self.incarnation)
        require_id("ticket_request.nonce", self.nonce)


class Instruction(StrEnum):
    """What an actor is to do."""

    COLLECT = "collect"
    WAIT = "wait"
    """Nothing to collect now: ask again."""
    DRAIN = "drain"
    """Deliver what is spooled, then leave."""
    STOP = "stop"
    """The run has ended: deliver what is spooled, then leave."""


@dataclass(frozen=True)
class TicketReply:
    """The owner's answer to a ticket request."""

    instruction: Instruction
    nonce: str
    owner_epoch: int
    ticket: Ticket | None = None

    def __post_init__(self) -> None:
        has_ticket = self.ticket is not None
        is_collect = self.instruction is Instruction.COLLECT
        require(has_ticket == is_collect, "ticket_reply.ticket", "one exactly with 'collect'", self)
