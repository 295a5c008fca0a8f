"""Which demonstrated states are targets."""

from __future__ import annotations

import pytest

from broker_config.errors import MessageError
from broker_config.messages import TargetsMarked, TrajectoryId
from discriminator.real_states import real_states
from discriminator.targets import target_rule, target_states
from tests.unit.discriminator.test_real_states import DEMONSTRATIONS, names


def mark(number: int, *states: int) -> TargetsMarked:
    return TargetsMarked(TrajectoryId("a", "b", number), states)


def test_without_marks_a_rule_decides_for_each_demonstration() -> None:
    by_reward = target_states(DEMONSTRATIONS, -0.1)
    assert [it.tolist() for it in by_reward] == [[False, True, False], [True, False]]
    by_success = target_states(DEMONSTRATIONS, None)
    assert [it.tolist() for it in by_success] == [[False, False, False], [False, True]]


def test_marks_decide_alone() -> None:
    marks = [mark(1, 1, 3)]
    for target_reward in (None, -0.1):
        real = real_states(DEMONSTRATIONS, target_reward, marks)
        assert names(real["target"]) == [11, 13]
        assert names(real["expert"]) == [11, 12, 13, 21, 22]


def test_marks_of_which_none_is_left_are_not_no_marks() -> None:
    """Or the rule would take over where a person's word was cut off."""
    assert names(real_states(DEMONSTRATIONS, -0.1, [])["target"]) == []
    assert names(real_states(DEMONSTRATIONS, -0.1, None)["target"]) == [12, 21]


def test_marks_of_something_else_are_refused() -> None:
    for foreign in (mark(3, 1), mark(2, 3)):
        with pytest.raises(MessageError, match="expected marks of states of the 2 demonstrations"):
            target_states(DEMONSTRATIONS, None, [foreign])


def test_the_rule_is_told_in_words() -> None:
    assert target_rule(-0.1, None) == "reward at least -0.1"
    assert target_rule(None, None) == "last states of successes"
    assert target_rule(-0.1, []) == "marked by a person"
