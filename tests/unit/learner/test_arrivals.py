from collections.abc import Callable
from pathlib import Path

from broker_config.codec import encode
from broker_config.journal import Journal
from broker_config.messages import AttemptEnded, Trajectory, Verdict
from learner.arrivals import Arrivals, Received


def test_a_resend_is_recognised_on_its_way_afterwards_and_in_another_epoch(
    tmp_path: Path, make_trajectory: Callable[..., Trajectory]
) -> None:
    first, second = make_trajectory(0).id, make_trajectory(1).id
    with Journal(tmp_path / "journal.sqlite") as journal:
        arrivals = Arrivals(journal)
        assert arrivals.verdict(first) is None
        arrivals.arrived(first, Verdict.SPARE)
        assert arrivals.verdict(first) is Verdict.SPARE
        assert not arrivals.are_durable([second, first])
        ended = AttemptEnded(0, 0, Verdict.SPARE, first, 3, False, "too late")
        journal.append([(f"ended/{first}", encode(ended))]).result(20)
        arrivals.committed(first)
        assert arrivals.are_durable([first])
        assert arrivals.verdict(first) is Verdict.SPARE
        assert arrivals.verdict(second) is None
        again = Arrivals(journal)
        again.committed(first)
        assert again.verdict(first) is Verdict.SPARE
        assert again.verdict(make_trajectory(0, incarnation="inc-2").id) is None


def test_one_that_overtook_an_earlier_one_does_not_hide_it(
    tmp_path: Path, make_trajectory: Callable[..., Trajectory]
) -> None:
    with Journal(tmp_path / "journal.sqlite") as journal:
        arrivals = Arrivals(journal)
        arrivals.arrived(make_trajectory(5).id, Verdict.ACCEPTED)
        assert arrivals.verdict(make_trajectory(4).id) is None


def test_what_was_received_is_given_once_and_the_oldest_make_way(
    make_trajectory: Callable[..., Trajectory],
) -> None:
    items = [make_trajectory(number) for number in range(3)]
    received = Received(most_bytes=2 * items[0].observations.nbytes)
    for item in items:
        received.put(item)
    assert received.take(items[0].id) is None
    assert received.take(items[2].id) is items[2]
    assert received.take(items[2].id) is None
    received.put(items[0])
    assert received.take(items[1].id) is items[1]
