"""Who is there: joining a run, and signs of life."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from broker_config.messages.rules import require, require_id

Role = Literal["router", "owner", "actor", "discriminator", "recorder", "evaluator", "observer"]
"""`owner` is the process that owns the run's journal: the learner."""


@dataclass(frozen=True)
class Attach:
    """A process asks the owner whether it may join.

    Its fields never change, and it is decoded at any schema version: only so can two versions tell
    each other that they differ.
    """

    role: str
    id: str
    incarnation: str
    schema_version: int
    software_version: str
    preset_digest: str
    """Empty when the process brings no preset of its own and takes the run's."""


@dataclass(frozen=True)
class Welcome:
    """The owner lets a process join."""

    run: str
    owner_epoch: int
    """Counts the owner's starts; acks and tickets carry it."""
    preset_json: str


@dataclass(frozen=True)
class Refusal:
    """The owner does not do what it was asked; decoded at any schema version, like `Attach`."""

    subject: str
    expected: str
    got: str
    advice: str


@dataclass(frozen=True)
class Heartbeat:
    """A process runs and is on the bus; without it, a living one is stopped or cut off.

    It comes from a thread of its own; `stalled_secs` tells of the main thread.
    """

    role: Role
    id: str
    incarnation: str
    host: str
    pid: int
    state: str
    """A word for a person: collecting, waiting, training."""
    stalled_secs: float
    """Since the main thread last got anywhere; a large one means that the process hangs."""
    numbers: Mapping[str, float]
    """Whatever `clothbus status` shows of this role: policy_version, spooled, iteration."""

    def __post_init__(self) -> None:
        require_id("heartbeat.id", self.id)
        require_id("heartbeat.incarnation", self.incarnation)
        require(self.stalled_secs >= 0, "heartbeat.stalled_secs", "0 or more", self.stalled_secs)
