"""Control: what a person may ask of a run."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Command(StrEnum):
    """What a person may ask of a run."""

    PAUSE = "pause"
    """Issue no tickets until `resume`."""
    RESUME = "resume"
    DRAIN = "drain"
    """The named actor delivers and leaves; without a name, all of them."""
    STOP = "stop"
    """Checkpoint and end."""
    FORGET = "forget"
    """The named follower will not come back: keep no policy versions for it any more."""


@dataclass(frozen=True)
class Control:
    """A person steers the run."""

    command: Command
    process: str | None = None
    """The actor to `drain`, the follower to `forget`."""


@dataclass(frozen=True)
class ControlReply:
    """The owner did as asked."""

    command: Command
    state: str
    """The run's state after it."""
