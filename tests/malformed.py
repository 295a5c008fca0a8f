"""Messages that must be refused, for every key: by hand, by hypothesis, and valid ones spoiled."""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import hypothesis
import hypothesis.strategies as st
import msgpack
import numpy as np

from broker_config.codec import SCHEMA_VERSION, SIZE_LIMITS, decode, encode
from broker_config.contract import CONTRACT, Row, check_sender
from broker_config.errors import MessageError
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import (
    Ack,
    Attach,
    Command,
    Control,
    DiscriminatorSnapshot,
    Heartbeat,
    JournalRequest,
    Metrics,
    Rewards,
    Role,
    Snapshot,
    SnapshotRequest,
    Ticket,
    TicketRequest,
    Trajectory,
    TrajectoryId,
    Verdict,
    View,
    weights_digest,
)
from broker_config.specs import NetworkSpec
from broker_config.structure import to_plain

FORGER = "forger"
LIFE = "life"

_NETWORK = NetworkSpec((84, 84, 1), 10, "plain", 1.0)
_TRAJECTORY = Trajectory(
    id=TrajectoryId(FORGER, LIFE, 0),
    ticket=Ticket(0, 0, 0, 7, 0, 2, 0.0),
    observations=np.zeros((3, 84, 84, 1), np.uint8),
    actions=np.zeros(2, np.int32),
    rewards=np.zeros(2, np.float32),
    terminated=False,
    truncated=True,
    success=False,
    guard=None,
    interrupted=False,
    ended_unix_secs=1.5,
)
VALID: dict[Kind, object] = {
    Kind.ATTACH: Attach("actor", FORGER, LIFE, SCHEMA_VERSION, "1", ""),
    Kind.TICKET: TicketRequest(FORGER, LIFE, "nonce"),
    Kind.TRAJECTORY: _TRAJECTORY,
    Kind.JOURNAL: JournalRequest("actor", FORGER, LIFE, 0, 0, 100),
    Kind.POLICY: Snapshot(0, 1, _NETWORK, b"weights", weights_digest(b"weights")),
    Kind.POLICY_VERSION: SnapshotRequest(0),
    Kind.METRICS: Metrics("actor", FORGER, LIFE, 0, 0, {"loss": 1.0}),
    Kind.VIEW: View(FORGER, LIFE, 0, 0, 0, 0, 1, 2, 0.5, b"picture", "png", 1.5),
    Kind.LIVE: Heartbeat("actor", FORGER, LIFE, "host", 1, "well", 0.0, {"spooled": 1.0}),
    Kind.CONTROL: Control(Command.PAUSE),
    Kind.REWARDS: Rewards(
        discriminator=FORGER,
        incarnation=LIFE,
        iteration=0,
        digest=weights_digest(b"of D_G"),
        rewards=np.zeros(2, np.float32),
        expert_version=1,
        target_version=2,
        state=b"state",
        state_digest=weights_digest(b"state"),
        numbers={"expert_loss": 1.0},
    ),
    Kind.DISCRIMINATORS: DiscriminatorSnapshot(
        FORGER, 0, 1, 2, b"weights", weights_digest(b"weights")
    ),
}
"""A message for each kind of key that would be taken."""

_WITHOUT_RANGE = {"schema_version", "pid", "action", "max_bytes", "owner_epoch"}
_WITH_DEFAULT = {"process", "gives_back", "marks", "motion"}

ROWS = {row.kind: row for row in CONTRACT}


def forged_key(run: str, kind: Kind) -> str:
    """The key of a kind under which the forger may speak."""
    return str(_parsed(run, kind))


def _parsed(run: str, kind: Kind) -> ParsedKey:
    role: Role = "discriminator" if kind is Kind.REWARDS else "actor"
    return ParsedKey(run, kind, role, FORGER, 0)


def is_refused(run: str, kind: Kind, payload: bytes) -> bool:
    """Whether the contract refuses a payload on the forger's key."""
    try:
        message = decode(payload, *ROWS[kind].messages)
        check_sender(_parsed(run, kind), message)
    except MessageError:
        return True
    return False


def hand_made(kind: Kind) -> Iterator[tuple[str, bytes]]:
    """What a person would try, each with a name."""
    message, row = VALID[kind], ROWS[kind]
    name, plain = type(message).__name__, to_plain(message)
    assert isinstance(plain, dict)
    yield from _no_messages()
    yield from _envelopes(name, plain)
    yield from _fields(name, plain)
    yield from _bombs(name, row)
    whole = encode(message)
    yield from ((f"cut at {n}", whole[:n]) for n in (1, 2, len(whole) // 2, len(whole) - 1))
    yield "with more behind it", whole + b"\x00"
    if "role" in plain or "actor" in plain or kind in (Kind.TRAJECTORY, Kind.REWARDS):
        yield "of another sender", _of_another_sender(message)
    if kind is Kind.TRAJECTORY:
        yield from _arrays(name, plain)


def _pack(name: object, fields: object, version: object = SCHEMA_VERSION) -> bytes:
    packed: bytes = msgpack.packb([version, name, fields])
    return packed


def _no_messages() -> Iterator[tuple[str, bytes]]:
    yield "empty", b""
    yield "text", b"not msgpack at all"
    yield "nothing", msgpack.packb(None)
    yield "a number", msgpack.packb(7)
    yield "a table", msgpack.packb({"version": SCHEMA_VERSION})
    yield "too short", msgpack.packb([SCHEMA_VERSION, "Attach"])
    yield "too long", msgpack.packb([SCHEMA_VERSION, "Attach", {}, None])
    yield "an unused byte of msgpack", b"\xc1"


def _envelopes(name: str, plain: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    if name != "Attach":  # two versions must be able to tell each other that they differ
        for version in (1, SCHEMA_VERSION - 1, SCHEMA_VERSION + 1, 0, -1, 2**40):
            yield f"schema version {version}", _pack(name, plain, version)
    for odd in ("2", 2.0, True, None, [2]):
        yield f"schema version {odd!r}", _pack(name, plain, odd)
    for odd_name in ("", "Nonsense", name.lower(), "__class__", "Trajectory\x00", 5, None, [name]):
        yield f"named {odd_name!r}", _pack(odd_name, plain)
    ack = Ack(TrajectoryId("a", "b", 0), 1, 0, Verdict.ACCEPTED, duplicate=False)
    yield "another message", encode(ack)
    for fields in (None, [], [1], "text", 5, {}, b"bytes"):
        yield f"fields {fields!r}", _pack(name, fields)


def _fields(name: str, plain: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    yield "an unknown field", _pack(name, {**plain, "unknown": 1})
    yield "a field with a number for its name", _pack(name, {**plain, 7: 1})
    for field, value in plain.items():
        rest = {key: item for key, item in plain.items() if key != field}
        if field not in _WITH_DEFAULT:
            yield f"without {field}", _pack(name, rest)
        for odd in _odd_values(value):
            yield f"{field} = {odd!r:.40}", _pack(name, {**plain, field: odd})
        if type(value) is int and field not in _WITHOUT_RANGE:
            yield f"a negative {field}", _pack(name, {**plain, field: -(2**63)})
            yield f"a {field} beyond 64 bits", _pack(name, {**plain, field: 2**63})


def _odd_values(value: object) -> list[object]:
    """Values of the wrong type or range in place of a right one."""
    foreign = [msgpack.ExtType(5, b"foreign"), msgpack.Timestamp(1, 1), {"a": {}}, [[[]]]]
    match value:
        case bool():
            return [*foreign, None, 0, "true"]
        case int():
            return [*foreign, "1", 0.5, True]
        case float():
            return [*foreign, "1", b"1", True]
        case str():
            return [*foreign, 5, value.encode(), "x" * 300_000]
        case bytes():
            return [*foreign, None, 5, "text"]
        case None:
            return [*foreign, 2.5, b"x"]
        case _:
            return [*foreign[:2], None, 5, "text"]


def _bombs(name: str, row: Row) -> Iterator[tuple[str, bytes]]:
    head = msgpack.packb([SCHEMA_VERSION, name])[1:]
    opened = b"\x93" + head
    yield "a list of 4 thousand million", opened + b"\xdd\xff\xff\xff\xff"
    yield "a table of 4 thousand million", opened + b"\xdf\xff\xff\xff\xff"
    yield "bytes of 4 GB", opened + b"\xc6\xff\xff\xff\xff"
    yield "text of 4 GB", opened + b"\xdb\xff\xff\xff\xff"
    yield "a foreign type of 4 GB", opened + b"\xc9\xff\xff\xff\xff\x05"
    yield "lists in lists", opened + b"\x91" * 3000 + b"\xc0"
    yield "tables in tables", opened + b"\x81\xa1a" * 1000 + b"\xc0"
    limit = SIZE_LIMITS[row.messages[0]]
    if limit < 1 << 20:
        yield "one byte too large", b"\x00" * (limit + 1)


def _of_another_sender(message: object) -> bytes:
    match message:
        case Trajectory():
            return encode(dataclasses.replace(message, id=TrajectoryId("victim", LIFE, 0)))
        case TicketRequest() | View():
            return encode(dataclasses.replace(message, actor="victim"))
        case Rewards():
            return encode(dataclasses.replace(message, discriminator="victim"))
        case _:
            return encode(dataclasses.replace(message, id="victim"))  # type: ignore[type-var]


def _arrays(name: str, plain: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    observations, rewards = plain["observations"], plain["rewards"]
    shapes: list[object] = [[-1, 84, 84, 1], [3, 84, 84], [2**62, 4], [0], [], "3", [3.0, 1], None]
    for shape in shapes:
        odd = {**plain, "observations": {**observations, "shape": shape}}
        yield f"pictures of shape {shape}", _pack(name, odd)
    for dtype in ("<f8", "object", "|O", ">f4", "", 5, "|V8"):
        odd = {**plain, "rewards": {**rewards, "dtype": dtype}}
        yield f"rewards of dtype {dtype}", _pack(name, odd)
    for number in (math.nan, math.inf, -math.inf):
        data = np.full(2, number, np.float32).tobytes()
        yield f"rewards of {number}", _pack(name, {**plain, "rewards": {**rewards, "data": data}})
    actions = np.full(2, -1, np.int32)
    yield "a negative action", _pack(name, {**plain, "actions": to_plain(actions)})
    yield "no steps", _pack(name, {**plain, "actions": to_plain(actions[:0])})
    yield "a time that is none", _pack(name, {**plain, "ended_unix_secs": math.nan})


# Made in any number ------------------------------------------------------------------------------

_LEAVES = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=20)
    | st.binary(max_size=20)
)
_VALUES = st.recursive(
    _LEAVES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=8,
)


def hypothesis_made(kind: Kind, count: int) -> list[bytes]:
    """Bytes, msgpack of any kind, and the valid message with fields of any value."""
    message = VALID[kind]
    name, plain = type(message).__name__, to_plain(message)
    assert isinstance(plain, dict)
    changed = st.dictionaries(st.sampled_from(sorted(plain)), _VALUES, min_size=1, max_size=3)
    strategy = (
        st.binary(max_size=200)
        | _VALUES.map(msgpack.packb)
        | changed.map(lambda fields: _pack(name, {**plain, **fields}))
        | st.tuples(_LEAVES, _LEAVES, _VALUES).map(lambda it: _pack(it[1], it[2], it[0]))
    )
    made: list[bytes] = []

    @hypothesis.settings(
        max_examples=count,
        database=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(strategy)
    def take(payload: bytes) -> None:
        made.append(payload)

    take()
    return made


def spoiled(kind: Kind, generator: random.Random) -> Iterator[bytes]:
    """The valid message with flipped bits, cut off, or with a part of it in another place."""
    whole = encode(VALID[kind])
    spoil: list[Callable[[bytearray], bytes]] = [
        lambda data: _flipped(data, generator),
        lambda data: bytes(data[: generator.randrange(len(data))]),
        lambda data: bytes(data) + generator.randbytes(generator.randint(1, 20)),
        lambda data: _moved(data, generator),
    ]
    while True:
        yield generator.choice(spoil)(bytearray(whole))


def _flipped(data: bytearray, generator: random.Random) -> bytes:
    # Most of what there is to break is at the beginning; pictures may have any bits.
    for _ in range(generator.randint(1, 4)):
        data[generator.randrange(min(len(data), 400))] ^= 1 << generator.randrange(8)
    return bytes(data)


def _moved(data: bytearray, generator: random.Random) -> bytes:
    first, last, to = (generator.randrange(min(len(data), 400)) for _ in range(3))
    part = data[min(first, last) : max(first, last) + 1]
    return bytes(data[:to] + part + data[to:])


@dataclass(frozen=True)
class Malformed:
    """A payload that must be refused on the forger's key of a kind."""

    kind: Kind
    payload: bytes


def malformed(run: str, kind: Kind, count: int, seed: int) -> list[Malformed]:
    """So many: all that are made by hand, a tenth by hypothesis, and the rest spoiled."""
    by_hand = [payload for _, payload in hand_made(kind)]
    assert len(by_hand) <= count, f"{kind}: {len(by_hand)} are made by hand"
    candidates = itertools.chain(
        by_hand,
        hypothesis_made(kind, max(1, count // 10)),
        spoiled(kind, random.Random(seed)),
    )
    refused = (payload for payload in candidates if is_refused(run, kind, payload))
    return [Malformed(kind, payload) for payload in itertools.islice(refused, count)]
