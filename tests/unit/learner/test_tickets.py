"""The ticket book: who collects what, which attempt counts, and that replay gives the same book."""

from __future__ import annotations

import dataclasses
import secrets
import tracemalloc

import numpy as np
import pytest

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
from deploy.presets import load_preset
from learner.tickets import (
    LEASE_SECS,
    LOST_ATTEMPTS_BEFORE_RESEED,
    TicketBook,
    TicketEvent,
    derive_seed,
)

BYTES_OF_A_COMPLETE_TICKET = 500
"""While its iteration lasts."""


class RecordedBook(TicketBook):
    """A book with a record of its own in the place of a journal."""

    def __init__(self, preset: Preset) -> None:
        self._record: dict[tuple[int, int], TicketIssued] = {}
        super().__init__(preset, lambda *key: self._record.get(key))

    def apply(self, event: TicketEvent) -> None:
        if isinstance(event, TicketIssued):
            self._record[event.ticket.index, event.ticket.attempt] = event
        super().apply(event)


@pytest.fixture
def preset() -> Preset:
    return load_preset("reaching-smoke", ["task.horizon=4"])


def ask(actor: str, incarnation: str = "first", nonce: str | None = None) -> TicketRequest:
    return TicketRequest(actor, incarnation, nonce or secrets.token_hex(4))


def trajectory(
    ticket: Ticket,
    actor: str = "a",
    steps: int | None = None,
    sequence: int = 0,
    incarnation: str = "first",
    **changes: object,
) -> Trajectory:
    steps = ticket.steps if steps is None else steps
    whole = Trajectory(
        id=TrajectoryId(actor, incarnation, sequence),
        ticket=ticket,
        observations=np.zeros((steps + 1, 84, 84, 1), np.uint8),
        actions=np.zeros(steps, np.int32),
        rewards=np.zeros(steps, np.float32),
        terminated=False,
        truncated=True,
        success=False,
        guard=None,
        interrupted=False,
        ended_unix_secs=0.0,
    )
    return dataclasses.replace(whole, **changes)  # type: ignore[arg-type]


def issue(book: TicketBook, request: TicketRequest, version: int = 99) -> Ticket:
    ticket, _ = book.issue(request, version, now_secs=0.0)
    assert ticket is not None
    return ticket


def verdict_of(events: list[TicketEvent]) -> Verdict:
    ended = events[0]
    assert isinstance(ended, AttemptEnded)
    return ended.verdict


def test_actors_get_different_tickets_and_a_repeated_nonce_the_same(preset: Preset) -> None:
    book = RecordedBook(preset)
    request = ask("a", nonce="once")
    first = issue(book, request)
    assert issue(book, ask("b")).index == first.index + 1
    assert book.repeated(request) == first
    assert book.repeated(ask("a", nonce="another")) is None


def test_a_ticket_that_is_given_back_goes_to_the_next_who_asks(preset: Preset) -> None:
    book = RecordedBook(preset)
    first = issue(book, ask("a"))
    request = dataclasses.replace(ask("a"), gives_back=(first.index, first.attempt))
    again, events = book.issue(request, 99, now_secs=0.0)
    assert verdict_of(events) is Verdict.LOST
    assert again is not None
    assert (again.index, again.attempt) == (first.index, first.attempt + 1)
    stolen = dataclasses.replace(ask("b"), gives_back=(again.index, again.attempt))
    other, _ = book.issue(stolen, 99, now_secs=0.0)
    assert other is not None
    assert other.index == first.index + 1


def test_a_ticket_waits_for_exactly_its_policy_version(preset: Preset) -> None:
    book = RecordedBook(preset)
    first = issue(book, ask("a"), version=0)
    assert book.issue(ask("b"), 0, now_secs=0.0) == (None, [])
    book.close(trajectory(first))
    assert issue(book, ask("b"), version=1).policy_version == 1


def test_a_policy_lag_lets_episodes_be_collected_side_by_side() -> None:
    book = RecordedBook(load_preset("reaching-smoke", ["schedule.policy_lag=2"]))
    versions = [issue(book, ask(actor), version=0).policy_version for actor in "abc"]
    assert versions == [0, 0, 0]
    assert book.issue(ask("d"), 0, now_secs=0.0)[0] is None
    assert issue(book, ask("d"), version=1).policy_version == 1


def test_the_first_complete_attempt_counts_and_a_later_one_is_spare(preset: Preset) -> None:
    book = RecordedBook(preset)
    slow = issue(book, ask("slow"))
    book.expire(now_secs=0.0)
    book.expire(now_secs=LEASE_SECS + 1)
    quick = issue(book, ask("quick"), version=0)
    assert (quick.index, quick.seed) == (slow.index, slow.seed)
    assert quick.attempt == slow.attempt + 1
    assert verdict_of(book.close(trajectory(slow, "slow"))) is Verdict.ACCEPTED
    assert verdict_of(book.close(trajectory(quick, "quick"))) is Verdict.SPARE
    assert book.parts(0) == (TrajectoryId("slow", "first", 0),)


def test_heartbeats_keep_a_slow_actor_s_ticket(preset: Preset) -> None:
    book = RecordedBook(preset)
    issue(book, ask("slow"))
    for now_secs in range(0, 100, int(LEASE_SECS)):
        book.heard("slow", "first", float(now_secs))
        assert book.expire(float(now_secs)) == []


def test_a_restarted_actor_loses_what_it_had(preset: Preset) -> None:
    book = RecordedBook(preset)
    before = issue(book, ask("a", "first"))
    ticket, events = book.issue(ask("a", "second"), 99, now_secs=0.0)
    assert verdict_of(events) is Verdict.LOST
    assert ticket is not None
    assert (ticket.index, ticket.seed, ticket.attempt) == (before.index, before.seed, 1)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"guard": "nan"}, "guard: nan"),
        ({"steps": 3}, "expected 4 steps; got 3"),
    ],
)
def test_invalid_attempts_are_not_learned_from(
    preset: Preset, changes: dict[str, object], reason: str
) -> None:
    book = RecordedBook(preset)
    events = book.close(trajectory(issue(book, ask("a")), **changes))  # type: ignore[arg-type]
    ended = events[0]
    assert isinstance(ended, AttemptEnded)
    assert (ended.verdict, ended.reason) == (Verdict.INVALID, reason)
    assert not book.is_complete(0)
    assert issue(book, ask("a")).attempt == 1


def test_a_ticket_that_was_not_issued_like_this_changes_nothing(preset: Preset) -> None:
    book = RecordedBook(preset)
    issued = issue(book, ask("a"))
    for wrong in (
        dataclasses.replace(issued, seed=issued.seed + 1),
        dataclasses.replace(issued, policy_version=7),
        dataclasses.replace(issued, attempt=5),
        dataclasses.replace(issued, index=3),
    ):
        assert verdict_of(book.close(trajectory(wrong))) is Verdict.UNASKED
    for wrong_sender in (
        trajectory(issued, "b"),
        trajectory(issued, incarnation="second"),
    ):
        assert verdict_of(book.close(wrong_sender)) is Verdict.UNASKED
    assert verdict_of(book.close(trajectory(issued))) is Verdict.ACCEPTED


def test_a_seed_that_the_guard_ends_is_replaced(preset: Preset) -> None:
    book = RecordedBook(preset)
    seeds = []
    for generation in range(3):
        ticket = issue(book, ask("a"))
        assert ticket.seed == derive_seed(preset.seed, 0, generation, part=0)
        seeds.append(ticket.seed)
        book.close(trajectory(ticket, sequence=generation, guard="overstretched"))
    assert len(set(seeds)) == 3


def test_a_trajectory_of_a_replaced_seed_does_not_count(preset: Preset) -> None:
    book = RecordedBook(preset)
    late = issue(book, ask("late"))
    book.close(trajectory(late, "late", sequence=0, guard="nan"))
    assert verdict_of(book.close(trajectory(late, "late", sequence=9))) is Verdict.SPARE


def test_kills_alone_replace_a_seed_only_after_many(preset: Preset) -> None:
    book = RecordedBook(preset)
    seeds = [
        issue(book, ask("a", f"life-{life}")).seed
        for life in range(LOST_ATTEMPTS_BEFORE_RESEED + 1)
    ]
    assert len(set(seeds[:-1])) == 1
    assert seeds[-1] != seeds[0]


def test_an_interrupted_attempt_counts_and_the_rest_is_collected(preset: Preset) -> None:
    book = RecordedBook(preset)
    first = issue(book, ask("robot"))
    part = trajectory(first, "robot", steps=3, interrupted=True)
    assert verdict_of(book.close(part)) is Verdict.ACCEPTED
    assert not book.is_complete(0)
    rest = issue(book, ask("robot"))
    assert (rest.index, rest.part, rest.steps) == (0, 1, 1)
    assert rest.seed != first.seed
    book.close(trajectory(rest, "robot", sequence=1))
    assert book.is_complete(0)
    assert [part.sequence for part in book.parts(0)] == [0, 1]


def test_a_run_ends_when_every_ticket_is_complete(preset: Preset) -> None:
    book = RecordedBook(preset)
    for sequence in range(preset.schedule.episodes):
        assert not book.all_complete
        book.close(trajectory(issue(book, ask("a")), sequence=sequence))
    assert book.all_complete
    assert book.issue(ask("a"), 99, now_secs=0.0)[0] is None


def test_dqn_tickets_carry_the_falling_epsilon() -> None:
    book = RecordedBook(load_preset("reaching-smoke", ["algorithm.method=dqn"]))
    epsilons = []
    for sequence in range(4):
        ticket = issue(book, ask("a"))
        epsilons.append(ticket.epsilon)
        book.close(trajectory(ticket, steps=10, sequence=sequence))
    assert epsilons == pytest.approx([1.0, 0.55, 0.1, 0.1])


def test_replaying_the_events_gives_the_same_book(preset: Preset) -> None:
    book, events = RecordedBook(preset), list[TicketEvent]()
    generator = np.random.default_rng(0)
    held: list[tuple[Ticket, TicketRequest]] = []
    for number in range(200):
        now_secs = float(number)
        events += book.expire(now_secs)
        if held and generator.random() < 0.5:
            ticket, holder = held.pop(int(generator.integers(len(held))))
            guard = "nan" if generator.random() < 0.5 else None
            played = trajectory(
                ticket,
                holder.actor,
                sequence=number,
                incarnation=holder.incarnation,
                guard=guard,
            )
            events += book.close(played)
        else:
            request = ask(f"actor-{generator.integers(3)}", f"life-{generator.integers(3)}")
            new, more = book.issue(request, 99, now_secs)
            events += more
            held += [(new, request)] if new else []
    replayed = RecordedBook(preset)
    for event in events:
        replayed.apply(event)
    assert {type(event) for event in events} == {TicketIssued, AttemptEnded, TicketReseeded}
    assert replayed.all_complete == book.all_complete
    for index in range(preset.schedule.episodes):
        assert replayed.is_complete(index) == book.is_complete(index)
    request = ask("actor-0", "new", nonce="same")
    assert replayed.issue(request, 99, 1e6)[0] == book.issue(request, 99, 1e6)[0]


def test_forgotten_tickets_stay_complete_and_their_late_attempts_are_judged_as_ever(
    preset: Preset,
) -> None:
    book = RecordedBook(preset)
    slow = issue(book, ask("slow"))
    book.expire(now_secs=0.0)
    book.expire(now_secs=LEASE_SECS + 1)
    quick = issue(book, ask("quick"))
    still_out = issue(book, ask("c"))
    book.close(trajectory(quick, "quick"))
    book.forget_before(2)
    assert book.is_complete(0)
    assert not book.is_complete(1), "what is incomplete is not forgotten"
    assert verdict_of(book.close(trajectory(slow, "slow"))) is Verdict.SPARE
    guarded = book.close(trajectory(slow, "slow", sequence=1, guard="nan"))
    assert [type(event) for event in guarded] == [AttemptEnded], "a complete seed is not replaced"
    forged = dataclasses.replace(slow, seed=slow.seed + 1)
    assert verdict_of(book.close(trajectory(forged, "slow", sequence=2))) is Verdict.UNASKED
    assert verdict_of(book.close(trajectory(still_out, "c"))) is Verdict.ACCEPTED
    assert issue(book, ask("d")).index == 2


def test_a_lost_ticket_is_issued_before_new_ones_and_only_once(preset: Preset) -> None:
    book = RecordedBook(preset)
    lost = issue(book, ask("a", "first"))
    issue(book, ask("b"))
    again = issue(book, ask("a", "second"))
    assert (again.index, again.attempt) == (lost.index, 1)
    assert issue(book, ask("c")).index == 2


def test_memory_of_a_ticket_is_small_and_ends_with_its_iteration() -> None:
    count = 2000
    settings = [f"schedule.iterations={count}", f"schedule.policy_lag={2 * count}"]
    book = TicketBook(load_preset("reaching-smoke", settings), lambda *_: None)
    whole = trajectory(issue(book, ask("a", nonce="warm")), steps=10)
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for number in range(count):
            ticket = issue(book, ask("a", nonce=f"n{number}"))
            id_ = TrajectoryId("a", "first", number)
            book.close(dataclasses.replace(whole, id=id_, ticket=ticket))
        complete_bytes = (tracemalloc.get_traced_memory()[0] - before) / count
        book.close(dataclasses.replace(whole, id=TrajectoryId("a", "first", count)))
        book.forget_before(count)
        kept_bytes = (tracemalloc.get_traced_memory()[0] - before) / count
    finally:
        tracemalloc.stop()
    assert complete_bytes < BYTES_OF_A_COMPLETE_TICKET
    assert kept_bytes < 150, "the table itself, which is used again for the next iteration"
