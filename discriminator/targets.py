"""Which demonstrated states are targets: those that a person marked, or those of a rule."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from broker_config.errors import MessageError
from broker_config.messages import TargetsMarked, Trajectory


def target_states(
    demonstrations: Sequence[Trajectory],
    target_reward: float | None,
    marks: Sequence[TargetsMarked] | None = None,
) -> list[NDArray[np.bool_]]:
    """For each demonstration, bool[T]: whether the state after each step is a target.

    Args:
        demonstrations: Any number.
        target_reward: Without marks, a state is a target where its task reward is at least this;
            with None the last state of each demonstration that succeeded at its end is one.
        marks: A person's; where they are not None they decide alone.

    Raises:
        MessageError: A mark is of no demonstration, or of a state that it does not have.
    """
    if marks is not None:
        return _marked(demonstrations, marks)
    if target_reward is not None:
        return [each.rewards >= target_reward for each in demonstrations]
    return [
        np.arange(each.steps) == (each.steps - 1 if each.success else each.steps)
        for each in demonstrations
    ]


def target_rule(target_reward: float | None, marks: Sequence[TargetsMarked] | None) -> str:
    """By what `target_states` decides, for a person."""
    if marks is not None:
        return "marked by a person"
    if target_reward is not None:
        return f"reward at least {target_reward:g}"
    return "last states of successes"


def _marked(
    demonstrations: Sequence[Trajectory], marks: Sequence[TargetsMarked]
) -> list[NDArray[np.bool_]]:
    targets = {each.id: np.zeros(each.steps, np.bool_) for each in demonstrations}
    for mark in marks:
        reached = targets.get(mark.trajectory)
        if reached is None or mark.states[-1:] > (len(reached),):
            raise MessageError(
                f"targets: expected marks of states of the {len(targets)} demonstrations; got "
                f"{list(mark.states)} of {mark.trajectory}; mark what is there"
            )
        reached[np.array(mark.states, np.int64) - 1] = True
    return [targets[each.id] for each in demonstrations]
