"""What is read of demonstrations, and what is left of them when they are cut."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from broker_config.codec import encode
from broker_config.errors import MessageError
from broker_config.journal import Journal
from broker_config.messages import (
    AttemptEnded,
    JournalEntry,
    RunStarted,
    TargetsMarked,
    Trajectory,
    Verdict,
)
from broker_config.recording.recording import Recording
from learner.recorded import Demonstrations, first_samples, read_demonstrations

Make = Callable[..., Trajectory]


def ended(trajectory: Trajectory, ticket: int, verdict: Verdict) -> AttemptEnded:
    return AttemptEnded(ticket, 0, verdict, trajectory.id, trajectory.steps, True, "")


def test_a_run_s_journal_and_its_recording_give_the_same(
    make_trajectory: Make, tmp_path: Path
) -> None:
    """The trajectories that count, in the order of their tickets."""
    trajectories = [make_trajectory(sequence) for sequence in range(4)]
    verdicts = [Verdict.ACCEPTED, Verdict.INVALID, Verdict.ACCEPTED, Verdict.ACCEPTED]
    entries = [("run/1", encode(RunStarted("smoke", 1, "{}", "0")))]
    for ticket, (each, verdict) in enumerate(zip(trajectories, verdicts, strict=True)):
        entries.append((f"trajectory/{each.id}", encode(each)))
        entries.append((f"ended/{each.id}", encode(ended(each, (3 - ticket), verdict))))
    with Journal(tmp_path / "journal.sqlite") as journal:
        journal.append(entries).result()
    folder = tmp_path / "recording"
    folder.mkdir()
    with Recording(folder, "smoke", "rec-1") as recording:
        for offset, (name, payload) in enumerate(entries):
            recording.add_entry(JournalEntry(offset, name, payload, 1.5))
        recording.finish()
    for path in (tmp_path, folder):
        read = read_demonstrations(path)
        assert [it.id.sequence for it in read.trajectories] == [3, 2, 0]
        assert [encode(it) for it in read.trajectories] == [
            encode(trajectories[sequence]) for sequence in (3, 2, 0)
        ]
        assert read.origin == RunStarted("smoke", 1, "{}", "0")
        assert read.marks is None


@pytest.mark.parametrize(
    ("samples", "steps", "marked"),
    [
        (100, [3, 3], [(1, 3), (2,)]),
        (5, [3, 2], [(1, 3), (2,)]),
        (4, [3, 1], [(1, 3)]),
        (2, [2], [(1,)]),
        (0, [], []),
    ],
)
def test_marks_behind_the_cut_go_with_it(
    make_trajectory: Make, samples: int, steps: list[int], marked: list[tuple[int, ...]]
) -> None:
    first, second = make_trajectory(0), make_trajectory(1)
    marks = (TargetsMarked(first.id, (1, 3)), TargetsMarked(second.id, (2,)))
    cut = first_samples(Demonstrations((first, second), marks), samples)
    assert [it.steps for it in cut.trajectories] == steps
    assert cut.marks is not None, "a person has decided"
    assert [it.states for it in cut.marks] == marked
    unmarked = first_samples(Demonstrations((first, second)), samples)
    assert [it.steps for it in unmarked.trajectories] == steps
    assert unmarked.marks is None


def test_what_was_cut_off_has_not_succeeded(make_trajectory: Make) -> None:
    succeeded = replace(make_trajectory(), success=True)
    (cut,) = first_samples(Demonstrations((succeeded,)), 2).trajectories
    assert (cut.steps, cut.success, cut.terminated) == (2, False, False)
    (kept,) = first_samples(Demonstrations((succeeded,)), 3).trajectories
    assert kept is succeeded


def test_marks_are_of_states_that_are_there(make_trajectory: Make) -> None:
    mine, other = make_trajectory(0), make_trajectory(1)
    Demonstrations((mine,), (TargetsMarked(mine.id, (3,)),))
    for mark in (TargetsMarked(mine.id, (4,)), TargetsMarked(other.id, (1,))):
        with pytest.raises(MessageError, match="expected marks of their own states"):
            Demonstrations((mine,), (mark,))
    for states in ((0,), (2, 1), (1, 1)):
        with pytest.raises(MessageError, match="expected ascending indices from 1 on"):
            TargetsMarked(mine.id, states)
