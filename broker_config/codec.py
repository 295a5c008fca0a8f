"""Messages to bytes and back: msgpack with a schema version, strict checks and size limits."""

from __future__ import annotations

from typing import Any, TypeVar

import msgpack

from broker_config import messages
from broker_config.errors import DecodeError, MessageError, SchemaMismatch
from broker_config.structure import from_plain, to_plain

SCHEMA_VERSION = 2
"""Raised with every change that an older process would misread."""

KIB, MIB = 1 << 10, 1 << 20

SIZE_LIMITS: dict[type, int] = {
    messages.Attach: 4 * KIB,
    messages.Welcome: 64 * KIB,
    messages.Refusal: 16 * KIB,
    messages.Heartbeat: 16 * KIB,
    messages.Metrics: 64 * KIB,
    messages.View: 256 * KIB,
    messages.TicketRequest: 4 * KIB,
    messages.TicketReply: 4 * KIB,
    messages.Trajectory: 64 * MIB,
    messages.Ack: 4 * KIB,
    messages.Snapshot: 256 * MIB,
    messages.SnapshotRequest: 4 * KIB,
    messages.JournalRequest: 4 * KIB,
    messages.JournalEntry: 65 * MIB,
    messages.JournalBatch: 96 * MIB,
    messages.Control: 4 * KIB,
    messages.ControlReply: 4 * KIB,
    messages.RunStarted: 64 * KIB,
    messages.TicketIssued: 4 * KIB,
    messages.AttemptEnded: 4 * KIB,
    messages.TicketReseeded: 4 * KIB,
    messages.SnapshotTaken: 4 * KIB,
    messages.IterationEnded: 4 * KIB,
    messages.FollowerJoined: 4 * KIB,
    messages.IterationAnnounced: 16 * MIB,
    messages.Rewards: 64 * MIB,
    messages.RewardsAck: 4 * KIB,
    messages.DiscriminatorSnapshot: 32 * MIB,
    messages.DemonstrationsBegun: 64 * KIB,
    messages.TargetsMarked: 64 * KIB,
    messages.RecorderStarted: 4 * KIB,
    messages.RecordingGap: 4 * KIB,
    messages.Presence: 4 * KIB,
}
"""Every message there is, and how many bytes it may take; more is refused at either end."""

_BY_NAME = {kind.__name__: kind for kind in SIZE_LIMITS}
_ANY_VERSION = frozenset({"Attach", "Refusal"})

M = TypeVar("M")


def encode(message: object) -> bytes:
    """Packs a message.

    Raises:
        MessageError: It is no message of the contract, or too large.
    """
    limit = SIZE_LIMITS.get(type(message))
    name = type(message).__name__
    if limit is None:
        raise MessageError(f"{name}: expected one of {', '.join(_BY_NAME)}")
    payload: bytes = msgpack.packb([SCHEMA_VERSION, name, to_plain(message)], use_bin_type=True)
    if len(payload) > limit:
        raise MessageError(f"{name}: expected at most {limit} bytes; got {len(payload)}")
    return payload


def decode(payload: bytes, *expected: type[M]) -> M:
    """Unpacks a message of one of the expected types.

    Arrays are read-only views of `payload`.

    Raises:
        SchemaMismatch: The sender has another schema version.
        DecodeError: The bytes are no message, another message, too large, or break a field's rule.
    """
    limit = max(SIZE_LIMITS[kind] for kind in expected)
    wanted = " or ".join(kind.__name__ for kind in expected)
    if len(payload) > limit:
        raise DecodeError(f"{wanted}: expected at most {limit} bytes; got {len(payload)}")
    version, name, body = _open_envelope(payload, wanted)
    if version != SCHEMA_VERSION and name not in _ANY_VERSION:
        raise SchemaMismatch(
            f"{wanted}: expected schema version {SCHEMA_VERSION}; got {version}; "
            "install the same clothbus version on both ends"
        )
    kind = next((kind for kind in expected if kind.__name__ == name), None)
    if kind is None:
        raise DecodeError(f"payload: expected {wanted}; got {name}")
    if len(payload) > SIZE_LIMITS[kind]:
        raise DecodeError(f"{name}: expected at most {SIZE_LIMITS[kind]} bytes; got {len(payload)}")
    try:
        return from_plain(body, kind, name)
    except MessageError as error:
        raise DecodeError(str(error)) from error
    except (TypeError, ValueError, OverflowError) as error:
        raise DecodeError(f"{name}: {error}") from error


def decode_any(payload: bytes) -> object:
    """Unpacks a message of whichever type, as journals hold them.

    Raises:
        SchemaMismatch: It was written by another schema version.
        DecodeError: It is no message.
    """
    return decode(payload, *SIZE_LIMITS)


def _open_envelope(payload: bytes, wanted: str) -> tuple[int, str, Any]:
    try:
        envelope = msgpack.unpackb(payload, raw=False, strict_map_key=True, max_ext_len=0)
    except Exception as error:  # msgpack raises its own, ValueError, and others on foreign bytes
        raise DecodeError(f"payload: expected {wanted} as msgpack; got {error!r}") from error
    if (
        not isinstance(envelope, list)
        or len(envelope) != 3
        or type(envelope[0]) is not int
        or not isinstance(envelope[1], str)
    ):
        raise DecodeError(
            f"payload: expected {wanted} as [version, name, fields]; got other msgpack"
        )
    return envelope[0], envelope[1], envelope[2]
