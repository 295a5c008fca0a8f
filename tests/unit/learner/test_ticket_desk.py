"""Long polls: every question is answered exactly once, whatever happens meanwhile."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from broker_config.journal import Journal
from broker_config.messages import Command, Control, Instruction, SnapshotTaken, TicketReply
from broker_config.messages import TicketRequest as Request
from deploy.presets import load_preset
from learner.owner import Owner
from learner.ticket_desk import TicketDesk

PRESET = load_preset("reaching-smoke", ["schedule.iterations=50"])


class Answers:
    """Collects answers; a second one to the same question fails, as on the bus."""

    def __init__(self) -> None:
        self.by_question: dict[int, TicketReply] = {}
        self.faults: list[str] = []

    def to(self, question: int) -> Callable[[TicketReply], None]:
        def answer(reply: TicketReply) -> None:
            if question in self.by_question:
                self.faults.append(f"question {question} answered twice")
                raise RuntimeError("answered twice")
            self.by_question[question] = reply

        return answer


@pytest.fixture
def owner(tmp_path: Path) -> Iterator[Owner]:
    with Journal(tmp_path / "journal.sqlite") as journal:
        yield Owner("run", PRESET, journal)


def test_a_held_question_is_answered_when_there_is_a_policy(
    owner: Owner, wait_until: Callable[..., None]
) -> None:
    answers = Answers()
    with TicketDesk(owner) as desk:
        desk.ask(Request("a", "life", "n"), answers.to(0))
        assert answers.by_question == {}
        owner.policy_ready(SnapshotTaken(0, "ab" * 32, 0))
        wait_until(lambda: 0 in answers.by_question, "the answer")
    assert answers.by_question[0].instruction is Instruction.COLLECT


def test_a_closing_desk_answers_everyone(owner: Owner) -> None:
    answers = Answers()
    with TicketDesk(owner) as desk:
        desk.ask(Request("a", "life", "n"), answers.to(0))
    assert answers.by_question[0].instruction is Instruction.WAIT


def test_a_storm_of_repeated_questions_is_answered_once_each(
    owner: Owner, wait_until: Callable[..., None]
) -> None:
    owner.policy_ready(SnapshotTaken(0, "ab" * 32, 0))
    answers, questions = Answers(), 400
    with TicketDesk(owner) as desk:

        def storm(first: int) -> None:
            for question in range(first, questions, 4):
                actor = f"actor-{question % 2}"
                desk.ask(Request(actor, "life", f"n{question // 8}"), answers.to(question))

        threads = [threading.Thread(target=storm, args=(first,)) for first in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        wait_until(lambda: len(answers.by_question) == questions, "all answers")
    assert answers.faults == []
    given = [reply.ticket for reply in answers.by_question.values() if reply.ticket]
    per_ticket = Counter(ticket.index for ticket in given)
    assert set(per_ticket) == {0}, "version 0 is for one ticket; each nonce gets the same"


def test_a_pause_holds_questions_back_until_the_resume(
    owner: Owner, wait_until: Callable[..., None]
) -> None:
    owner.policy_ready(SnapshotTaken(0, "ab" * 32, 0))
    owner.control(Control(Command.PAUSE))
    answers = Answers()
    with TicketDesk(owner) as desk:
        desk.ask(Request("a", "life", "n"), answers.to(0))
        assert answers.by_question == {}
        owner.control(Control(Command.RESUME))
        wait_until(lambda: 0 in answers.by_question, "the answer")
    assert answers.by_question[0].instruction is Instruction.COLLECT


def test_actors_that_wait_cost_nothing_while_there_is_nothing_for_them(
    owner: Owner, wait_until: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    actors, changes = 20, 50
    decided = Counter[str]()
    issue = owner.issue

    def counted(request: Request, now_secs: float) -> object:
        decided[request.actor] += 1
        return issue(request, now_secs)

    monkeypatch.setattr(owner, "issue", counted)
    answers = Answers()
    with TicketDesk(owner) as desk:
        for actor in range(actors):
            desk.ask(Request(f"a-{actor}", "life", "n"), answers.to(actor))
        wait_until(lambda: len(decided) == actors, "each is looked at")
        for _ in range(changes):
            owner.note_change()
        owner.policy_ready(SnapshotTaken(0, "ab" * 32, 0))
        wait_until(lambda: answers.by_question, "one gets the only ticket")
    assert decided.total() <= 2 * actors
    given = [it.instruction for it in answers.by_question.values()]
    assert Counter(given) == {Instruction.COLLECT: 1, Instruction.WAIT: actors - 1}
