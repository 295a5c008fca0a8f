"""Questions and answers through a real router."""

import threading
import time

import pytest

from broker_config.bus import Bus
from broker_config.codec import encode
from broker_config.errors import (
    BusError,
    DecodeError,
    MessageError,
    OwnerFailed,
    OwnerUnreachable,
    Refused,
)
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import (
    Ack,
    Command,
    Control,
    ControlReply,
    Instruction,
    Metrics,
    Refusal,
    TicketReply,
    TicketRequest,
    Trajectory,
    Verdict,
)
from broker_config.session import open_session
from tests.conftest import until_declared

REQUEST = TicketRequest("actor-01", "inc-1", "nonce-1")


def wait_reply(nonce):
    return TicketReply(Instruction.WAIT, nonce, owner_epoch=3)


@pytest.fixture
def owner(attach):
    return attach("owner", "learner")


def serve(owner, pattern, request_type, handler):
    owner.serve(pattern, request_type, handler)
    until_declared(owner)


@pytest.fixture
def actor(attach):
    return attach("actor", "actor-01")


@pytest.fixture
def ask_ticket(actor):
    def ask(timeout_secs=10.0):
        key = actor.keys.ticket("actor-01")
        return actor.ask(key, REQUEST, TicketReply, timeout_secs=timeout_secs)

    return ask


def test_an_answer_reaches_the_asker(owner, ask_ticket):
    seen = []

    def answer(key, request, responder):
        seen.append((key, request))
        responder.reply(wait_reply(request.nonce))

    serve(owner, owner.keys.every(Kind.TICKET), TicketRequest, answer)
    assert ask_ticket() == wait_reply("nonce-1")
    assert seen == [(ParsedKey(owner.keys.run, Kind.TICKET, "actor", "actor-01"), REQUEST)]


def test_a_question_may_be_answered_later_from_another_thread_and_once(owner, actor, ask_ticket):
    held = []
    arrived = threading.Event()

    def hold(key, request, responder):
        held.append(responder)
        arrived.set()

    serve(owner, owner.keys.every(Kind.TICKET), TicketRequest, hold)

    def answer_when_asked():
        arrived.wait(10)
        held[0].reply(wait_reply("nonce-1"))

    threading.Thread(target=answer_when_asked).start()
    assert ask_ticket() == wait_reply("nonce-1")
    with pytest.raises(RuntimeError, match="answered twice"):
        held[0].reply(wait_reply("nonce-1"))


def test_a_question_dropped_unanswered_does_not_hang_the_asker(owner, ask_ticket):
    serve(owner, owner.keys.every(Kind.TICKET), TicketRequest, lambda *_: None)
    started = time.monotonic()
    with pytest.raises(OwnerUnreachable):
        ask_ticket(timeout_secs=60)
    assert time.monotonic() - started < 30


def test_closing_the_owner_releases_held_questions(attach, actor, ask_ticket):
    owner = attach("owner", "learner")
    held = []
    serve(
        owner, owner.keys.every(Kind.TICKET), TicketRequest, lambda key, request, r: held.append(r)
    )
    reply = actor.ask_later(
        actor.keys.ticket("actor-01"), encode(REQUEST), TicketReply, timeout_secs=60
    )
    while not held:
        time.sleep(0.002)
    started = time.monotonic()
    owner.close()
    with pytest.raises(OwnerUnreachable):
        reply.result()
    assert time.monotonic() - started < 30
    assert held[0].is_answered


def test_an_owner_that_does_not_answer_in_time_is_unreachable(owner, ask_ticket, wait_until):
    held = []
    serve(
        owner, owner.keys.every(Kind.TICKET), TicketRequest, lambda key, request, r: held.append(r)
    )
    with pytest.raises(OwnerUnreachable, match="none in time"):
        ask_ticket(timeout_secs=0.2)
    wait_until(lambda: held, "the question arrives, on a busy machine later than that")
    held[0].reply(wait_reply("nonce-1"))  # too late, and no error


def test_nobody_serves_the_key(ask_ticket):
    with pytest.raises(OwnerUnreachable, match="nobody who serves it"):
        ask_ticket()


def test_a_failing_handler_is_told_and_lives_on(owner, ask_ticket, caplog):
    outcomes = iter([ZeroDivisionError("one over none"), None])

    def answer(key, request, responder):
        if (error := next(outcomes)) is not None:
            raise error
        responder.reply(wait_reply(request.nonce))

    serve(owner, owner.keys.every(Kind.TICKET), TicketRequest, answer)
    with pytest.raises(OwnerFailed, match="ZeroDivisionError: one over none"):
        ask_ticket()
    assert any("/ticket/actor-01" in record.getMessage() for record in caplog.records)
    assert ask_ticket() == wait_reply("nonce-1")


def test_a_handler_refuses_with_a_message_error_or_a_refusal(owner, ask_ticket):
    refusal = Refusal("preset", "digest a", "digest b", "use the run's preset")
    outcomes = iter([MessageError("seed: expected 3; got 4; send 3"), refusal])

    def answer(key, request, responder):
        outcome = next(outcomes)
        if isinstance(outcome, MessageError):
            raise outcome
        responder.reply(outcome)

    serve(owner, owner.keys.every(Kind.TICKET), TicketRequest, answer)
    with pytest.raises(Refused) as first:
        ask_ticket()
    assert str(first.value) == "seed: expected 3; got 4; send 3"
    with pytest.raises(Refused, match="preset: expected digest a; got digest b; use the run's"):
        ask_ticket()


def test_a_window_of_trajectories_is_acked_each_for_itself(owner, actor, make_trajectory):
    def commit(key, request, responder):
        responder.reply(Ack(request.id, 1, request.id.sequence, Verdict.ACCEPTED, duplicate=False))

    serve(owner, owner.keys.every(Kind.TRAJECTORY), Trajectory, commit)
    window = [
        actor.ask_later(
            actor.keys.trajectory("actor-01"),
            encode(make_trajectory(sequence=sequence, steps=30)),
            Ack,
            timeout_secs=30,
        )
        for sequence in range(8)
    ]
    assert [reply.result().id.sequence for reply in window] == list(range(8))


def test_a_trajectory_under_another_actors_key_is_refused(owner, actor, make_trajectory):
    serve(owner, owner.keys.every(Kind.TRAJECTORY), Trajectory, lambda *_: pytest.fail("handled"))
    foreign = encode(make_trajectory(actor="actor-02"))
    key = actor.keys.trajectory("actor-01")
    with pytest.raises(Refused, match="expected the sender of its key, actor actor-01"):
        actor.ask_later(key, foreign, Ack, timeout_secs=10).result()
    assert owner.rejected.counts == {(key, "MessageError"): 1}


def test_requests_and_replies_keep_to_the_contract(owner, actor, ask_ticket):
    with pytest.raises(MessageError, match="expected a message of the contract; got Metrics"):
        actor.ask(
            actor.keys.control, Metrics("actor", "a", "i", 0, 0, {}), ControlReply, timeout_secs=1
        )

    def answer(key, request, responder):
        responder.reply(ControlReply(Command.PAUSE, "paused"))

    serve(owner, owner.keys.every(Kind.TICKET), TicketRequest, answer)
    with pytest.raises(OwnerFailed, match="expected a reply of the contract; got ControlReply"):
        ask_ticket()


def test_an_unexpected_answer_is_an_error(owner, actor):
    def answer(key, request, responder):
        responder.reply(ControlReply(request.command, "paused"))

    serve(owner, owner.keys.control, Control, answer)
    with pytest.raises(DecodeError, match="expected TicketReply or Refusal; got ControlReply"):
        actor.ask(actor.keys.control, Control(Command.PAUSE), TicketReply, timeout_secs=10)


def test_a_closed_bus_says_so(actor, ask_ticket):
    actor.close()
    actor.close()
    with pytest.raises(BusError, match="expected an open bus"):
        ask_ticket()


def test_what_is_declared_on_a_closed_bus_of_an_open_session_does_not_stay(router, run_name):
    with open_session("client", router.address) as session:
        bus = Bus(session, run_name, "owner", "learner")
        bus.close()
        for declare in (
            bus.declare_alive,
            lambda: bus.serve(bus.keys.control, Control, lambda *_: None),
            lambda: bus.latest_publisher(bus.keys.policy),
        ):
            with pytest.raises(BusError, match="expected an open bus"):
                declare()
        assert Bus(session, run_name, "observer", "o").alive() == []
