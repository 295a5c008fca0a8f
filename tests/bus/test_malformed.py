"""What is malformed is refused, counted under its key and its kind of reason, and kills nothing."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable

import pytest
import zenoh

from broker_config.codec import encode
from broker_config.contract import CONTRACT, Delivery
from broker_config.errors import BusError, MessageError, OwnerUnreachable, Refused
from broker_config.heart import Heart, Pulse
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import Heartbeat, TicketReply
from broker_config.session import open_session
from tests.conftest import Attach, RouterProcess, until_declared
from tests.malformed import ROWS, VALID, forged_key, hand_made, is_refused, malformed

QUERIES = [row.kind for row in CONTRACT if row.delivery is Delivery.QUERY]
PER_KEY = 300
BLOCK = zenoh.CongestionControl.BLOCK
"""Sent like this, none is dropped on the way on a busy machine."""


@pytest.mark.parametrize("kind", Kind, ids=lambda kind: kind.name)
def test_everything_made_by_hand_is_refused_and_the_original_is_not(kind: Kind) -> None:
    assert not is_refused("run", kind, encode(VALID[kind]))
    taken = [name for name, payload in hand_made(kind) if not is_refused("run", kind, payload)]
    assert taken == []


@pytest.mark.parametrize("kind", QUERIES, ids=lambda kind: kind.name)
def test_each_malformed_question_is_refused_and_counted(
    attach: Attach, run_name: str, kind: Kind
) -> None:
    owner, forger = attach("owner", "owner"), attach("actor", "forger")
    served: list[object] = []
    owner.serve(owner.keys.every(kind), ROWS[kind].messages[0], lambda *it: served.append(it))
    until_declared(owner)
    key = forged_key(run_name, kind)
    pending = [
        forger.ask_later(key, bad.payload, TicketReply, timeout_secs=30)
        for bad in malformed(run_name, kind, PER_KEY, seed=1)
    ]
    for reply in pending:
        with pytest.raises(Refused):
            reply.result()
    assert served == []
    assert owner.rejected.total == PER_KEY
    names, reasons = zip(*owner.rejected.counts, strict=True)
    assert set(names) == {key}
    assert set(reasons) <= {"DecodeError", "SchemaMismatch", "MessageError"}


@pytest.mark.parametrize("kind", [Kind.LIVE, Kind.METRICS, Kind.VIEW], ids=lambda kind: kind.name)
def test_each_malformed_message_is_dropped_and_counted(
    attach: Attach,
    router: RouterProcess,
    run_name: str,
    kind: Kind,
    wait_until: Callable[..., None],
) -> None:
    reader = attach("recorder", "recorder")
    taken: list[object] = []
    reader.subscribe(reader.keys.every(kind), ROWS[kind].messages[0], lambda *it: taken.append(it))
    until_declared(reader)
    key, bad = forged_key(run_name, kind), malformed(run_name, kind, PER_KEY, seed=2)
    with open_session("client", router.address) as session:
        session.put(key, bad[0].payload, congestion_control=BLOCK)
        wait_until(lambda: reader.rejected.total == 1, "the first is counted")
        for number in range(1, len(bad), 50):  # fewer than what a reader keeps waiting
            batch = bad[number : number + 50]
            for item in batch:
                session.put(key, item.payload, congestion_control=BLOCK)
            expected = number + len(batch)
            wait_until(lambda n=expected: reader.rejected.total == n, f"{expected} are counted")
    assert taken == []
    assert {name for name, _ in reader.rejected.counts} == {key}


def test_keys_that_are_none_are_counted_by_their_names(
    attach: Attach, router: RouterProcess, run_name: str, wait_until: Callable[..., None]
) -> None:
    owner = attach("owner", "owner")
    for kind in (Kind.TICKET, Kind.ATTACH, Kind.POLICY_VERSION):
        owner.serve(owner.keys.every(kind), ROWS[kind].messages[0], lambda *_: None)
    until_declared(owner)
    names = ["ticket/Upper", f"ticket/{'x' * 65}", "attach/king/id", "policy/007", "policy/-1"]
    wildcards = {"ticket/*": 1, "*/forger": 2, "attach/**": 1}
    expected = Counter({f"{run_name}/{name}": 1 for name in names})
    expected.update({f"{run_name}/{name}": count for name, count in wildcards.items()})
    with open_session("client", router.address) as session:
        for key, count in expected.items():
            replies = list(session.get(key, payload=b"", timeout=10))
            assert [reply.err is not None for reply in replies] == [True] * count, key
    assert Counter({name: n for (name, _), n in owner.rejected.counts.items()}) == expected


def test_an_answer_that_is_malformed_is_an_error_of_the_asker(
    attach: Attach, router: RouterProcess, run_name: str, wait_until: Callable[..., None]
) -> None:
    actor = attach("actor", "actor-01")
    request = dataclasses.replace(VALID[Kind.TICKET], actor="actor-01")  # type: ignore[type-var]
    key = str(ParsedKey(run_name, Kind.TICKET, "actor", "actor-01"))
    answers = [b"", b"\xc1", encode(VALID[Kind.LIVE]), b"\xdd\xff\xff\xff\xff"]

    def is_an_error() -> bool:
        try:
            actor.ask(key, request, TicketReply, timeout_secs=10)
        except OwnerUnreachable:  # the router has not heard of the forger yet
            return False
        except MessageError:
            return True
        pytest.fail("the answer was taken")

    with open_session("client", router.address) as session:
        left = iter(answers)
        with session.declare_queryable(key, lambda query: query.reply(key, next(left))):
            for number in range(len(answers)):
                wait_until(is_an_error, f"answer {number} is refused")
    with pytest.raises(BusError):
        actor.ask(key, request, TicketReply, timeout_secs=10)


def test_heartbeats_tell_how_much_was_rejected(
    attach: Attach, run_name: str, wait_until: Callable[..., None]
) -> None:
    owner, observer = attach("owner", "owner"), attach("observer", "observer")
    heard: list[Heartbeat] = []
    observer.subscribe(observer.keys.every(Kind.LIVE), Heartbeat, lambda _, it: heard.append(it))
    until_declared(observer)
    for _ in range(3):
        owner.rejected.count("some/key", ValueError())
    with Heart(owner, "owner", "owner", "life", lambda: ("well", {"episode": 4}), Pulse()):
        wait_until(lambda: heard, "a heartbeat")
    assert heard[0].numbers == {"episode": 4, "rejected": 3}
