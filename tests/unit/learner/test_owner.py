"""The owner: what is told is in the journal, and a restart knows all that was told."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

from broker_config.codec import SCHEMA_VERSION, decode, encode
from broker_config.errors import MessageError, StorageError
from broker_config.journal import Appended, Journal
from broker_config.messages import (
    Ack,
    Attach,
    Command,
    Control,
    Instruction,
    IterationEnded,
    Refusal,
    SnapshotTaken,
    TargetsMarked,
    Ticket,
    TicketReply,
    TicketRequest,
    Trajectory,
    TrajectoryId,
    Verdict,
    Welcome,
)
from broker_config.preset import Preset
from broker_config.version import VERSION
from deploy.presets import load_preset
from learner.owner import Owner
from learner.recorded import Demonstrations, accepted_trajectories
from learner.run_journal import MOST_GENERATIONS

PRESET = load_preset("reaching-smoke", ["task.horizon=3"])


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    with Journal(tmp_path / "journal.sqlite") as opened:
        yield opened


def own(journal: Journal, preset: Preset = PRESET, version: int = 0) -> Owner:
    owner = Owner("run", preset, journal)
    owner.policy_ready(SnapshotTaken(version, "ab" * 32, 0))
    return owner


def ask(owner: Owner, actor: str = "a", nonce: str = "n", life: str = "life") -> TicketReply | None:
    issued = owner.issue(TicketRequest(actor, life, nonce), now_secs=0.0)
    if issued is None:
        return None
    reply, committed = issued
    committed.result(10)
    return reply


def play(reply: TicketReply | None, sequence: int = 0) -> Trajectory:
    assert reply is not None
    assert reply.ticket is not None
    steps = reply.ticket.steps
    return Trajectory(
        id=TrajectoryId("a", "life", sequence),
        ticket=reply.ticket,
        observations=np.full((steps + 1, 84, 84, 1), sequence, np.uint8),
        actions=np.zeros(steps, np.int32),
        rewards=np.ones(steps, np.float32),
        terminated=False,
        truncated=True,
        success=True,
        guard=None,
        interrupted=False,
        ended_unix_secs=0.0,
    )


def deliver(owner: Owner, trajectory: Trajectory) -> Ack:
    return owner.receive(trajectory, encode(trajectory)).result(10)


def test_an_acked_trajectory_is_in_the_journal(journal: Journal) -> None:
    owner = own(journal)
    sent = play(ask(owner))
    ack = deliver(owner, sent)
    assert (ack.id, ack.verdict, ack.duplicate) == (sent.id, Verdict.ACCEPTED, False)
    stored = journal.read(ack.offset, 1)[0]
    assert stored.name == f"trajectory/{sent.id}"
    assert encode(decode(stored.payload, Trajectory)) == encode(sent)
    assert owner.is_ready(0)


def test_a_resend_is_acked_again_and_counts_once(journal: Journal) -> None:
    owner = own(journal)
    sent = play(ask(owner))
    first, again = deliver(owner, sent), deliver(owner, sent)
    assert (again.offset, again.verdict, again.duplicate) == (first.offset, first.verdict, True)
    assert len(list(accepted_trajectories(journal))) == 1


def test_a_resend_after_the_owner_s_restart_counts_once(journal: Journal) -> None:
    sent = play(ask(own(journal)))
    deliver(Owner("run", PRESET, journal), sent)
    restarted = own(journal)
    assert restarted.epoch == 3
    again = deliver(restarted, sent)
    assert (again.duplicate, again.owner_epoch) == (True, restarted.epoch)
    assert restarted.is_ready(0)
    assert [item.id for item in restarted.trajectories(0)] == [sent.id]


def test_a_nonce_gets_the_same_ticket_from_the_next_owner(journal: Journal) -> None:
    before = ask(own(journal))
    after = ask(own(journal))
    assert before is not None
    assert after is not None
    assert before.ticket == after.ticket


def test_what_the_network_cannot_learn_from_is_refused_and_not_kept(journal: Journal) -> None:
    owner = own(journal)
    sent = play(ask(owner))
    wrong = dataclasses.replace(sent, observations=np.zeros((4, 84, 84, 3), np.uint8))
    with pytest.raises(MessageError, match=r"uint8 \[T\+1, 84, 84, 1\].*\[4, 84, 84, 3\] from a"):
        owner.receive(wrong, encode(wrong))
    beyond = dataclasses.replace(sent, actions=np.full(3, 10, np.int32))
    with pytest.raises(MessageError, match="below 10; got 10 from a"):
        owner.receive(beyond, encode(beyond))
    assert journal.entries(prefix="trajectory/") == []


def test_a_journal_of_another_preset_is_refused(journal: Journal) -> None:
    own(journal)
    with pytest.raises(StorageError, match="another preset"):
        own(journal, dataclasses.replace(PRESET, seed=7))


class FailingJournal(Journal):
    """A journal whose disk fills up when told."""

    is_full = False

    def append(self, entries: Sequence[tuple[str, bytes]]) -> Future[tuple[Appended, ...]]:
        if not self.is_full:
            return super().append(entries)
        failed: Future[tuple[Appended, ...]] = Future()
        failed.set_exception(StorageError("journal: disk is full"))
        return failed


def test_after_one_failed_append_nothing_more_is_issued_or_acked(tmp_path: Path) -> None:
    with FailingJournal(tmp_path / "journal.sqlite") as journal:
        owner = own(journal)
        sent = play(ask(owner))
        journal.is_full = True
        with pytest.raises(StorageError, match="disk is full"):
            deliver(owner, sent)
        journal.is_full = False  # too late: book and journal no longer agree
        for attempt in (
            lambda: deliver(owner, sent),
            lambda: ask(owner),
            lambda: owner.wait_ready(0, 0.0),
            lambda: owner.control(Control(Command.PAUSE)),
            lambda: owner.expire_leases(1e6),
        ):
            with pytest.raises(StorageError, match="disk is full"):
                attempt()
        again = own(journal)
        assert deliver(again, sent).verdict is Verdict.ACCEPTED
        assert again.is_ready(0)


def test_many_large_trajectories_at_once_do_not_stop_owner_and_journal(
    journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("broker_config.journal._PENDING_BYTES", 50_000)
    owner = own(journal)
    sent = play(ask(owner))
    others = [dataclasses.replace(sent, id=TrajectoryId("a", "life", n)) for n in range(40)]
    acks = [owner.receive(other, encode(other)) for other in others]
    verdicts = [ack.result(20).verdict for ack in acks]
    assert verdicts == [Verdict.ACCEPTED, *[Verdict.SPARE] * 39]


def test_a_ticket_that_no_seed_solves_ends_the_run(journal: Journal) -> None:
    owner = own(journal)
    for sequence in range(MOST_GENERATIONS):
        broken = dataclasses.replace(play(ask(owner, nonce=f"n{sequence}"), sequence), guard="nan")
        deliver(owner, broken)
    with pytest.raises(StorageError, match="ticket 0: expected a sound attempt"):
        owner.wait_ready(0, 0.0)
    assert owner.attempts[Verdict.INVALID] == MOST_GENERATIONS


@pytest.mark.parametrize(
    ("changes", "subject"),
    [
        ({"schema_version": SCHEMA_VERSION + 1}, "schema version"),
        ({"software_version": "0.0.1"}, "clothbus version"),
        ({"preset_digest": "00" * 32}, "preset digest"),
    ],
)
def test_attaching_with_something_else_is_refused_with_both_values(
    journal: Journal, changes: dict[str, object], subject: str
) -> None:
    owner = own(journal)
    request = Attach("actor", "a", "life", SCHEMA_VERSION, VERSION, PRESET.digest)
    assert owner.attach(request) == Welcome("run", owner.epoch, PRESET.to_json())
    refusal = owner.attach(dataclasses.replace(request, **changes))  # type: ignore[arg-type]
    assert isinstance(refusal, Refusal)
    assert refusal.subject == subject
    assert refusal.got == str(next(iter(changes.values())))
    assert refusal.expected != refusal.got


def test_pause_resume_drain_and_stop_reach_actors_through_tickets(journal: Journal) -> None:
    owner = own(journal)

    def instruction(actor: str = "a") -> Instruction | None:
        reply = ask(owner, actor, nonce="n" + actor)
        return reply.instruction if reply else None

    assert owner.control(Control(Command.PAUSE)).state == "paused"
    assert instruction() is None  # held, so that nobody asks in a tight loop
    assert owner.control(Control(Command.RESUME)).state == "running"
    assert instruction() is Instruction.COLLECT
    owner.control(Control(Command.PAUSE))
    assert instruction() is Instruction.COLLECT  # a lost answer is given again, paused or not
    owner.control(Control(Command.DRAIN, "b"))
    assert instruction("b") is Instruction.DRAIN
    assert owner.control(Control(Command.STOP)).state == "stopping"
    assert instruction() is Instruction.STOP


def test_a_pause_outlives_the_owner(journal: Journal) -> None:
    own(journal).control(Control(Command.PAUSE))
    again = own(journal)
    assert again.is_paused
    assert ask(again) is None


@pytest.mark.parametrize("process", ["a", None])
def test_a_drain_outlives_the_owner_until_the_run_is_resumed(
    journal: Journal, process: str | None
) -> None:
    own(journal).control(Control(Command.DRAIN, process), ["a"])
    again = own(journal)
    request = TicketRequest("a", "life", "nonce")
    issued = again.issue(request, 0.0)
    assert issued is not None
    assert issued[0].instruction is Instruction.DRAIN
    again.control(Control(Command.RESUME))
    resumed = own(journal).issue(request, 0.0)
    assert resumed is not None
    assert resumed[0].instruction is Instruction.COLLECT


def test_after_its_iteration_a_resend_is_still_recognised(journal: Journal) -> None:
    owner = own(journal)
    first = play(ask(owner))
    before = deliver(owner, first)
    owner.policy_ready(SnapshotTaken(1, "cd" * 32, 1))
    later = play(ask(owner, nonce="later"), 1)
    deliver(owner, later)
    owner.iteration_ended(IterationEnded(0, "ef" * 32, 0.0, 0.0))
    for resent, offset in ((first, before.offset), (later, None)):
        again = deliver(owner, resent)
        assert (again.verdict, again.duplicate) == (Verdict.ACCEPTED, True)
        assert offset in (again.offset, None)
    other = dataclasses.replace(first, id=TrajectoryId("a", "life", 2))
    assert deliver(owner, other).verdict is Verdict.SPARE, "issued, says the journal, and complete"
    forged = dataclasses.replace(
        other, id=TrajectoryId("a", "life", 3), ticket=dataclasses.replace(first.ticket, attempt=5)
    )
    assert deliver(owner, forged).verdict is Verdict.UNASKED


def test_a_sequence_number_below_the_newest_that_never_arrived_is_new(journal: Journal) -> None:
    owner = own(journal)
    sent = play(ask(owner), 7)
    assert deliver(owner, sent).duplicate is False
    earlier = dataclasses.replace(sent, id=TrajectoryId("a", "life", 3))
    assert deliver(owner, earlier).duplicate is False
    assert deliver(owner, earlier).duplicate is True


def test_demonstrations_and_what_was_marked_are_one_part_of_the_record(tmp_path: Path) -> None:
    first, second = (demonstration(number) for number in range(2))
    marked = Demonstrations((first, second), (TargetsMarked(second.id, (2, 3)),))
    with Journal(tmp_path / "journal.sqlite") as journal:
        own(journal).given.keep(marked)
        named = {it.name: it for it in journal.entries() if it.name[0] in "dt"}
        assert [*named] == ["demonstration/000000", "demonstration/000001", "target/000001"]
        (mark,) = marked.marks or ()
        assert decode(named["target/000001"].payload, TargetsMarked) == mark
    with Journal(tmp_path / "journal.sqlite") as journal:
        owner = own(journal)
        kept = owner.given.read()
        assert [it.id for it in kept.trajectories] == [first.id, second.id]
        assert kept.marks == marked.marks
        owner.given.keep(marked)  # the same again
        others = [
            Demonstrations((first, second)),
            Demonstrations((first, second), (TargetsMarked(second.id, (2,)),)),
            Demonstrations((second, first), marked.marks),
            Demonstrations((first,)),
        ]
        before = journal.end_offset
        for other in others:
            with pytest.raises(
                StorageError, match=r"expected the 2 .* and the same targets marked"
            ):
                owner.given.keep(other)
        assert journal.end_offset == before


def test_without_marks_nothing_is_marked(journal: Journal) -> None:
    owner = own(journal)
    owner.given.keep(Demonstrations((demonstration(0),)))
    assert owner.given.read().marks is None
    wrong = cropped(demonstration(1))
    with pytest.raises(MessageError, match="actor and learner run different presets"):
        own(journal).given.keep(Demonstrations((wrong,)))


def demonstration(number: int) -> Trajectory:
    ticket = Ticket(number, 0, 0, 0, 0, 3, 0.0)
    return play(TicketReply(Instruction.COLLECT, "n", 1, ticket), number)


def cropped(trajectory: Trajectory) -> Trajectory:
    return dataclasses.replace(trajectory, observations=trajectory.observations[:, :36, :36])
