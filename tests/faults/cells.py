"""What is done to which process: the cells of the fault matrix, and which are still to be done."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum

from broker_config.failpoints import Failpoint


class Role(StrEnum):
    ACTOR = "actor"
    LEARNER = "learner"
    RECORDER = "recorder"
    ROUTER = "router"
    EVALUATOR = "evaluator"
    DISCRIMINATOR = "discriminator"


class Fault(StrEnum):
    KILL = "kill -9"
    STOP = "SIGSTOP 12 s"
    RESTART = "restart (SIGTERM)"


STOP_SECS = 12.0

ROLE_OF_POINT = {
    **dict.fromkeys(
        (
            Failpoint.TICKET_RECEIVED,
            Failpoint.EPISODE_PLAYED,
            Failpoint.EPISODE_SPOOLED,
            Failpoint.TRAJECTORY_SENT,
            Failpoint.ACK_RECEIVED,
        ),
        Role.ACTOR,
    ),
    **dict.fromkeys(
        (
            Failpoint.TRAJECTORY_RECEIVED,
            Failpoint.TRAJECTORY_JOURNALED,
            Failpoint.TICKET_JOURNALED,
            Failpoint.EPISODE_ABSORBED,
            Failpoint.POLICY_UPDATED,
            Failpoint.FILE_WRITTEN,
            Failpoint.CHECKPOINT_SAVED,
            Failpoint.SNAPSHOT_STORED,
            Failpoint.ITERATION_JOURNALED,
            Failpoint.SNAPSHOT_JOURNALED,
            Failpoint.SNAPSHOT_PUBLISHED,
            Failpoint.ITERATION_ANNOUNCED,
            Failpoint.REWARDS_RECEIVED,
            Failpoint.REWARDS_JOURNALED,
        ),
        Role.LEARNER,
    ),
    **dict.fromkeys(
        (
            Failpoint.BATCH_RECEIVED,
            Failpoint.BATCH_WRITTEN,
            Failpoint.BATCH_HELD,
            Failpoint.RECORDING_RECOVERED,
        ),
        Role.RECORDER,
    ),
    **dict.fromkeys(
        (Failpoint.EVALUATION_PLAYED, Failpoint.EVALUATION_WRITTEN),
        Role.EVALUATOR,
    ),
    **dict.fromkeys(
        (
            Failpoint.ANNOUNCEMENT_FOLLOWED,
            Failpoint.REWARDS_MADE,
            Failpoint.REWARDS_ACKED,
            Failpoint.DISCRIMINATORS_PUBLISHED,
        ),
        Role.DISCRIMINATOR,
    ),
}
"""Which process is killed at a failpoint.

All are here but the one that only a robot's actor reaches, after it was killed in mid-episode
(`tests/process/test_failpoints.py` has it): the runs of the matrix have simulators.
"""

AT_START = frozenset({Failpoint.RECORDING_RECOVERED})
"""Only a process that has just been killed, and starts again, gets here."""


IMITATION_ONLY = frozenset(
    {Failpoint.ITERATION_ANNOUNCED, Failpoint.REWARDS_RECEIVED, Failpoint.REWARDS_JOURNALED}
)
"""The learner's failpoints that only a run with discriminators reaches."""


@dataclass(frozen=True)
class Cell:
    """A column of the matrix: a fault of a role at random moments, or its kill at a failpoint."""

    role: Role
    fault: Fault
    failpoint: Failpoint | None = None

    @property
    def is_of_imitation(self) -> bool:
        return self.role is Role.DISCRIMINATOR or self.failpoint in IMITATION_ONLY

    @property
    def name(self) -> str:
        return f"at {self.failpoint}" if self.failpoint else self.fault.value


FAILPOINT_CELLS = tuple(Cell(role, Fault.KILL, point) for point, role in ROLE_OF_POINT.items())


def still_to_do(
    wanted: Mapping[Cell, int], done: Iterable[Cell], shuffler: random.Random
) -> list[Cell]:
    """The faults that are missing from so many of each cell, in random order."""
    missing = list((Counter(wanted) - Counter(done)).elements())
    shuffler.shuffle(missing)
    return missing
