"""Messages survive the codec, and nothing else gets through it."""

import dataclasses
import typing

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from broker_config import codec, messages
from broker_config.codec import SCHEMA_VERSION, SIZE_LIMITS, decode, decode_any, encode
from broker_config.errors import DecodeError, MessageError, SchemaMismatch
from broker_config.messages import (
    Ack,
    Attach,
    DemonstrationsBegun,
    Demonstrator,
    DiscriminatorSnapshot,
    FoundQuality,
    Heartbeat,
    ImportedDataset,
    Instruction,
    IterationAnnounced,
    JointMotion,
    JournalBatch,
    JournalEntry,
    JournalRequest,
    Mark,
    Metrics,
    Refusal,
    Rewards,
    RewardsAck,
    Snapshot,
    SnapshotPlayed,
    TargetsMarked,
    Ticket,
    TicketReply,
    TicketRequest,
    Trajectory,
    TrajectoryId,
    Verdict,
    View,
    generated_digest,
    weights_digest,
)
from broker_config.specs import NetworkSpec

ids = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,63}", fullmatch=True)
counts = st.integers(0, 2**63 - 1)
texts = st.text(max_size=50)
finite = st.floats(allow_nan=False, allow_infinity=False)
numbers = st.dictionaries(texts, finite, max_size=5)
trajectory_ids = st.builds(TrajectoryId, ids, ids, counts)
tickets = st.builds(
    Ticket, counts, counts, counts, counts, counts, st.integers(1, 1000), st.floats(0, 1)
)
specs = st.builds(
    NetworkSpec,
    st.tuples(st.integers(1, 100), st.integers(1, 100), st.sampled_from([1, 3])),
    st.integers(2, 300),
    st.sampled_from(["plain", "dueling-penalty", "dueling-exact", "dueling-mean"]),
    st.floats(1e-3, 1e3),
)


@st.composite
def trajectories(draw):
    steps, height, width = draw(st.tuples(*[st.integers(1, 4)] * 3))
    channels = draw(st.sampled_from([1, 3]))
    return Trajectory(
        id=draw(trajectory_ids),
        ticket=draw(tickets),
        observations=draw(arrays.arrays(np.uint8, (steps + 1, height, width, channels))),
        actions=draw(arrays.arrays(np.int32, steps, elements=st.integers(0, 2**31 - 1))),
        rewards=draw(arrays.arrays(np.float32, steps, elements=st.floats(-100, 100, width=32))),
        terminated=draw(st.booleans()),
        truncated=draw(st.booleans()),
        success=draw(st.booleans()),
        guard=draw(st.none() | texts),
        interrupted=draw(st.booleans()),
        ended_unix_secs=draw(finite),
    )


@st.composite
def snapshots(draw):
    weights = draw(st.binary(max_size=100))
    return Snapshot(draw(counts), draw(counts), draw(specs), weights, weights_digest(weights))


@st.composite
def ticket_replies(draw):
    instruction = draw(st.sampled_from(Instruction))
    ticket = draw(tickets) if instruction is Instruction.COLLECT else None
    return TicketReply(instruction, draw(ids), draw(counts), ticket)


points = st.tuples(finite, finite)
marks = st.lists(
    st.builds(Mark, st.sampled_from(["pick", "drop"]), st.tuples(points))
    | st.builds(Mark, st.just("fold_line"), st.tuples(points, points)),
    max_size=4,
).map(tuple)


@st.composite
def motions(draw):
    joints = tuple(draw(st.lists(texts, min_size=1, max_size=3)))
    k = draw(st.integers(1, 4))
    secs = arrays.arrays(np.float32, k, elements=st.floats(0, 100, width=32))
    angles = arrays.arrays(np.float32, (k, len(joints)), elements=st.floats(-4, 4, width=32))
    return JointMotion(joints, draw(secs), draw(angles))


@st.composite
def views(draw):
    step = draw(st.integers(0, 3))
    action = draw(counts) if step else None
    reward = draw(finite) if step else None
    numbers = [draw(counts) for _ in range(4)]
    picture = draw(st.binary(max_size=50)), draw(st.sampled_from(["png", "jpeg"])), draw(finite)
    done = (draw(marks), draw(st.none() | motions())) if step else ()
    return View(draw(ids), draw(ids), *numbers, step, action, reward, *picture, *done)


@st.composite
def announcements(draw):
    generated = draw(st.lists(trajectory_ids, min_size=1, max_size=4).map(tuple))
    samples = len(generated) + draw(st.integers(0, 100))
    digest = generated_digest(generated, samples)
    return IterationAnnounced(draw(counts), digest, samples, generated)


@st.composite
def rewards(draw):
    given = draw(arrays.arrays(np.float32, 3, elements=st.floats(-5, 5, width=32)))
    versions = draw(st.sampled_from([(1, 1), (None, 2), (3, None)]))
    state = draw(st.binary(max_size=50))
    digests = weights_digest(b"of D_G"), weights_digest(state)
    names = draw(ids), draw(ids), draw(counts)
    return Rewards(*names, digests[0], given, *versions, state, digests[1], draw(numbers))


@st.composite
def discriminator_snapshots(draw):
    weights = draw(st.binary(max_size=50))
    digest = weights_digest(weights)
    return DiscriminatorSnapshot(draw(ids), draw(counts), 1, None, weights, digest)


rates = st.floats(0, 1)
qualities = st.builds(FoundQuality, finite, finite, finite, finite, counts)
digests = st.from_regex(r"[0-9a-f]{64}", fullmatch=True)
demonstrators = st.one_of(
    st.builds(Demonstrator, st.just("scripted"), rates, st.none() | qualities),
    st.just(Demonstrator("random")),
    st.builds(
        Demonstrator,
        st.just("imported"),
        dataset=st.builds(ImportedDataset, texts.filter(bool), digests, texts),
    ),
    st.builds(
        Demonstrator,
        st.just("policy"),
        snapshot=st.builds(SnapshotPlayed, ids, counts, digests, rates),
    ),
)
states = st.sets(st.integers(1, 1000), max_size=9).map(lambda some: tuple(sorted(some)))


any_message = st.one_of(
    announcements(),
    rewards(),
    discriminator_snapshots(),
    st.builds(RewardsAck, counts, counts, counts, st.booleans()),
    trajectories(),
    snapshots(),
    ticket_replies(),
    st.builds(Attach, texts, texts, texts, st.integers(0, 1000), texts, texts),
    st.builds(Refusal, texts, texts, texts, texts),
    st.builds(TicketRequest, ids, ids, ids),
    st.builds(Metrics, st.sampled_from(["owner", "actor"]), ids, ids, counts, counts, numbers),
    st.builds(
        Heartbeat, st.just("actor"), ids, ids, texts, counts, texts, st.floats(0, 1e9), numbers
    ),
    views(),
    st.builds(DemonstrationsBegun, demonstrators, counts, texts, texts),
    st.builds(TargetsMarked, trajectory_ids, states),
    st.builds(JournalRequest, st.just("recorder"), ids, ids, counts, counts, st.integers(1, 2**60)),
    st.builds(Ack, trajectory_ids, counts, counts, st.sampled_from(Verdict), st.booleans()),
    st.builds(
        JournalBatch,
        counts,
        st.lists(
            st.builds(JournalEntry, counts, texts, st.binary(max_size=50), finite), max_size=3
        ).map(tuple),
        counts,
        st.booleans(),
    ),
)


def assert_same(left, right):
    assert type(left) is type(right)
    if dataclasses.is_dataclass(left):
        for field in dataclasses.fields(left):
            assert_same(getattr(left, field.name), getattr(right, field.name))
    elif isinstance(left, np.ndarray):
        assert left.dtype == right.dtype
        np.testing.assert_array_equal(left, right)
    else:
        assert left == right


@given(any_message)
def test_a_message_survives(message):
    assert_same(decode(encode(message), type(message)), message)
    assert_same(decode_any(encode(message)), message)


@given(st.binary(max_size=200))
def test_foreign_bytes_are_a_decode_error_and_nothing_else(payload):
    with pytest.raises((DecodeError, SchemaMismatch)):
        decode(payload, Trajectory, Refusal)


anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats()
    | texts
    | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=12,
)


@given(st.sampled_from(sorted(SIZE_LIMITS, key=lambda kind: kind.__name__)), anything)
def test_a_body_of_anything_is_a_message_or_a_decode_error(kind, body):
    payload = msgpack.packb([SCHEMA_VERSION, kind.__name__, body])
    try:
        message = decode(payload, kind)
    except DecodeError:
        return
    assert_same(decode(encode(message), kind), message)


@given(trajectories(), st.data())
def test_a_damaged_trajectory_is_refused_or_is_still_a_sound_one(trajectory, data):
    payload = bytearray(encode(trajectory))
    position = data.draw(st.integers(0, len(payload) - 1))
    payload[position] = data.draw(st.integers(0, 255))
    try:
        decoded = decode(bytes(payload), Trajectory)
    except MessageError:
        return
    assert decoded.observations.shape[0] == decoded.steps + 1
    assert np.isfinite(decoded.rewards).all()


def test_received_arrays_cannot_be_changed(make_trajectory):
    received = decode(encode(make_trajectory()), Trajectory)
    with pytest.raises(ValueError, match="read-only"):
        received.observations[0] = 0


def test_another_schema_version_is_named_but_an_attach_or_refusal_is_read():
    def of_version(version, message):
        return encode(message).replace(bytes([0x93, SCHEMA_VERSION]), bytes([0x93, version]), 1)

    with pytest.raises(SchemaMismatch, match="expected schema version 2; got 3; install the same"):
        decode(of_version(3, TicketRequest("a", "i", "n")), TicketRequest)
    attach = Attach("actor", "a", "i", 3, "0.2", "")
    refusal = Refusal("s", "e", "g", "a")
    assert decode(of_version(3, attach), Attach) == attach
    assert decode(of_version(3, refusal), TicketReply, Refusal) == refusal


def test_another_message_is_named():
    with pytest.raises(DecodeError, match="expected Ack or Refusal; got TicketRequest"):
        decode(encode(TicketRequest("a", "i", "n")), Ack, Refusal)


def test_size_limits_hold_at_both_ends():
    with pytest.raises(MessageError, match="Attach: expected at most 4096 bytes; got 5"):
        encode(Attach("x" * 5000, "a", "i", 1, "0", ""))
    with pytest.raises(DecodeError, match="expected at most 4096 bytes"):
        decode(bytes(5000), Attach)
    oversized = msgpack.packb([SCHEMA_VERSION, "Ack", "x" * 5000])
    with pytest.raises(DecodeError, match="Ack: expected at most 4096 bytes"):
        decode(oversized, Ack, Refusal)


def test_what_is_no_message_cannot_be_sent():
    with pytest.raises(MessageError, match="dict: expected one of Attach"):
        encode({"a": 1})


def test_every_message_of_the_contract_has_a_size_limit():
    defined = {
        kind
        for kind in vars(messages).values()
        if dataclasses.is_dataclass(kind) and kind.__module__.startswith(messages.__name__)
    }
    parts = {
        Demonstrator,
        FoundQuality,
        ImportedDataset,
        JointMotion,
        Mark,
        SnapshotPlayed,
        Ticket,
        TrajectoryId,
    }
    assert defined - parts == set(SIZE_LIMITS)
    assert typing.get_type_hints(codec)["SIZE_LIMITS"] == dict[type, int]


def test_msgpack_extensions_are_refused():
    payload = msgpack.packb([SCHEMA_VERSION, "Ack", msgpack.ExtType(5, b"x")])
    with pytest.raises(DecodeError):
        decode(payload, Ack)
