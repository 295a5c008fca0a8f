"""The bus contract as data: which message travels under which key, between whom, and how.

The README's table is this table; a test holds the two together. Whoever speaks on the bus does so
through `bus.Bus`, which takes types and quality of service from here.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from broker_config import messages
from broker_config.errors import MessageError
from broker_config.keys import Kind, ParsedKey


class Delivery(StrEnum):
    """What a sender may count on."""

    QUERY = "query"
    """The asker gets a reply or an error, and asks again until it has a reply."""
    LATEST = "latest"
    """Every reader has the newest message in the end, also one that joins late."""
    BEST_EFFORT = "best effort"
    """Dropped rather than delaying anybody."""
    LIVELINESS = "liveliness, best effort"
    """A token that vanishes with its process, and on the same key a best-effort message."""


Congestion = Literal["block", "drop"]
Priority = Literal["interactive_high", "interactive_low", "data_high", "data", "data_low"]


@dataclass(frozen=True)
class Quality:
    """Zenoh's quality of service, by Zenoh's names."""

    congestion: Congestion
    """`block` only where one process reads: one stopped reader would stall all others."""
    priority: Priority
    """Higher ones overtake the fragments of a large message."""
    is_express: bool
    """Sent at once, not batched."""
    is_reliable: bool = True


@dataclass(frozen=True)
class Row:
    """One line of the contract."""

    kind: Kind
    messages: tuple[type, ...]
    """What is published, or asked."""
    replies: tuple[type, ...]
    """What is answered, besides a `Refusal`; empty unless it is a query."""
    publisher: str
    consumer: str
    delivery: Delivery
    quality: Quality
    why: str


CONTRACT: tuple[Row, ...] = (
    Row(
        kind=Kind.ATTACH,
        messages=(messages.Attach,),
        replies=(messages.Welcome,),
        publisher="any process that joins",
        consumer="owner",
        delivery=Delivery.QUERY,
        quality=Quality("block", "interactive_high", is_express=True),
        why="two versions or presets that differ are told so before anything else is said",
    ),
    Row(
        kind=Kind.TICKET,
        messages=(messages.TicketRequest,),
        replies=(messages.TicketReply,),
        publisher="actor",
        consumer="owner",
        delivery=Delivery.QUERY,
        quality=Quality("block", "interactive_high", is_express=True),
        why="the owner holds the question until there is a ticket; a repeat gets the same one",
    ),
    Row(
        kind=Kind.TRAJECTORY,
        messages=(messages.Trajectory,),
        replies=(messages.Ack,),
        publisher="actor",
        consumer="owner",
        delivery=Delivery.QUERY,
        quality=Quality("block", "data", is_express=False),
        why="acked once it is committed, resent until then: publish and subscribe loses some",
    ),
    Row(
        kind=Kind.JOURNAL,
        messages=(messages.JournalRequest,),
        replies=(messages.JournalBatch,),
        publisher="follower",
        consumer="owner",
        delivery=Delivery.QUERY,
        quality=Quality("block", "data_low", is_express=False),
        why="followers pull at their own pace, so that a slow one delays nobody and loses nothing",
    ),
    Row(
        kind=Kind.REWARDS,
        messages=(messages.Rewards,),
        replies=(messages.RewardsAck,),
        publisher="discriminator",
        consumer="owner",
        delivery=Delivery.QUERY,
        quality=Quality("block", "data", is_express=False),
        why="acked once they are committed: nothing is learned from rewards that are not kept",
    ),
    Row(
        kind=Kind.DISCRIMINATORS,
        messages=(messages.DiscriminatorSnapshot,),
        replies=(),
        publisher="discriminator",
        consumer="observers",
        delivery=Delivery.LATEST,
        quality=Quality("drop", "data_low", is_express=False),
        why="what is rewarded can be looked at while it changes; the journal has every version",
    ),
    Row(
        kind=Kind.POLICY,
        messages=(messages.Snapshot,),
        replies=(),
        publisher="owner",
        consumer="actors, observers",
        delivery=Delivery.LATEST,
        quality=Quality("drop", "data_high", is_express=False),
        why="many read it: a stopped one must not stall the rest; cache and recovery fill gaps",
    ),
    Row(
        kind=Kind.POLICY_VERSION,
        messages=(messages.SnapshotRequest,),
        replies=(messages.Snapshot,),
        publisher="actor",
        consumer="owner",
        delivery=Delivery.QUERY,
        quality=Quality("block", "data_high", is_express=False),
        why="a ticket names exactly one version, which may be older than the newest",
    ),
    Row(
        kind=Kind.METRICS,
        messages=(messages.Metrics,),
        replies=(),
        publisher="any process",
        consumer="recorder, observers",
        delivery=Delivery.BEST_EFFORT,
        quality=Quality("drop", "data_low", is_express=False, is_reliable=False),
        why="only looked at; nothing may wait for a viewer",
    ),
    Row(
        kind=Kind.VIEW,
        messages=(messages.View,),
        replies=(),
        publisher="actor",
        consumer="recorder, observers",
        delivery=Delivery.BEST_EFFORT,
        quality=Quality("drop", "data_low", is_express=False, is_reliable=False),
        why="pictures to look at; sequence numbers tell what was dropped",
    ),
    Row(
        kind=Kind.LIVE,
        messages=(messages.Heartbeat,),
        replies=(),
        publisher="any process",
        consumer="owner, observers",
        delivery=Delivery.LIVELINESS,
        quality=Quality("drop", "interactive_low", is_express=True, is_reliable=False),
        why="the token tells of a dead process, the missing heartbeat of a hung one",
    ),
    Row(
        kind=Kind.CONTROL,
        messages=(messages.Control,),
        replies=(messages.ControlReply,),
        publisher="console, command line",
        consumer="owner",
        delivery=Delivery.QUERY,
        quality=Quality("block", "interactive_high", is_express=True),
        why="a person must know whether it was done",
    ),
)

_BY_KIND = {row.kind: row for row in CONTRACT}


def row_of(kind: Kind) -> Row:
    """The contract's line for a kind of key."""
    return _BY_KIND[kind]


def check_sender(key: ParsedKey, message: object) -> None:
    """Refuses a message that names another sender than its key does.

    Raises:
        MessageError: Role or id differ.
    """
    role, sender = _sender_of(message)
    if sender is None or (role, sender) == (key.role, key.id):
        return
    raise MessageError(
        f"{type(message).__name__}: expected the sender of its key, {key.role} {key.id}; "
        f"got {role} {sender}; every process publishes under its own id"
    )


def _sender_of(message: object) -> tuple[str | None, str | None]:
    match message:
        case messages.Trajectory():
            return "actor", message.id.actor
        case messages.TicketRequest() | messages.View():
            return "actor", message.actor
        case messages.Rewards():
            return "discriminator", message.discriminator
        case (
            messages.Attach()
            | messages.Heartbeat()
            | messages.Metrics()
            | messages.JournalRequest()
        ):
            return message.role, message.id
        case _:
            return None, None


def markdown_table() -> str:
    """The contract as the README prints it."""
    lines = ["| key | message | publisher | consumer | delivery |", "|---|---|---|---|---|"]
    for row in CONTRACT:
        said = " or ".join(f"`{kind.__name__}`" for kind in row.messages)
        answered = " or ".join(f"`{kind.__name__}`" for kind in row.replies)
        message = f"{said}, answered by {answered}" if row.replies else said
        lines.append(
            f"| `{row.kind}` | {message} | {row.publisher} | {row.consumer} "
            f"| {row.delivery}: {row.why} |"
        )
    return "\n".join(lines)
