"""What may be said on the bus: frozen messages that refuse to exist when they are wrong.

Shapes use T for the steps of a trajectory and H, W, C for height, width and channels of a picture.
The README of this folder lists the key under which each message travels.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from broker_config.errors import MessageError
from broker_config.specs import NetworkSpec

Role = Literal["router", "owner", "actor", "observer"]
"""`owner` is the process that owns the run's journal: the learner."""

_ID = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
_DIGEST = re.compile(r"[0-9a-f]{64}")


def require_id(subject: str, value: str) -> str:
    """Returns `value` if it can name a run, an actor or an incarnation.

    Raises:
        MessageError: It is empty, too long, or has a character that a key must not have.
    """
    if not _ID.fullmatch(value):
        raise MessageError(
            f"{subject}: expected 1 to 64 of a-z, 0-9, '-', '_', starting with a letter or digit; "
            f"got {value!r}; choose another name"
        )
    return value


def _require(condition: bool, subject: str, rule: str, got: object) -> None:
    if not condition:
        raise MessageError(f"{subject}: expected {rule}; got {got}")


def _require_count(subject: str, value: int) -> None:
    _require(0 <= value < 2**63, subject, "a count of 0 or more", value)


def _require_digest(subject: str, value: str) -> None:
    _require(bool(_DIGEST.fullmatch(value)), subject, "64 hexadecimal digits", repr(value))


def _require_array(
    subject: str, array: NDArray[Any], dtype: str, shape: tuple[int | None, ...]
) -> None:
    fits = len(array.shape) == len(shape) and all(
        rule is None or size == rule for size, rule in zip(array.shape, shape, strict=True)
    )
    if array.dtype != np.dtype(dtype) or not fits:
        rule = ", ".join("any" if size is None else str(size) for size in shape)
        raise MessageError(
            f"{subject}: expected {dtype} [{rule}]; got {array.dtype} {list(array.shape)}"
        )


# Who is there ---------------------------------------------------------------------------------


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
    """A process runs and is on the bus; without it, a living one is stopped or cut off."""

    role: Role
    id: str
    incarnation: str
    host: str
    pid: int
    state: str
    """A word for a person: collecting, waiting, training."""
    numbers: Mapping[str, float]
    """Whatever `clothbus status` shows of this role: policy_version, spooled, iteration."""

    def __post_init__(self) -> None:
        require_id("heartbeat.id", self.id)
        require_id("heartbeat.incarnation", self.incarnation)


@dataclass(frozen=True)
class Metrics:
    """Named numbers of one moment of a process."""

    role: Role
    id: str
    step: int
    """The count against which the numbers are plotted: episodes absorbed, for the learner."""
    numbers: Mapping[str, float]

    def __post_init__(self) -> None:
        require_id("metrics.id", self.id)
        _require_count("metrics.step", self.step)


# Tickets --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ticket:
    """Collect one episode with this seed on exactly this policy version."""

    index: int
    """Place of the episode in the run; the memory is ordered by it, never by arrival."""
    attempt: int
    """Counts the issues of this index."""
    part: int
    """Counts the trajectories already accepted for this index: 0 except after a robot's crash."""
    seed: int
    """Seeds the environment and the policy."""
    policy_version: int
    steps: int
    """Steps to collect: the horizon, or what an interrupted attempt left of it."""
    epsilon: float
    """Probability of a random action; 0 for policies that sample by themselves."""

    def __post_init__(self) -> None:
        for name in ("index", "attempt", "part", "seed", "policy_version"):
            _require_count(f"ticket.{name}", getattr(self, name))
        _require(self.steps >= 1, "ticket.steps", "at least 1", self.steps)
        _require(0 <= self.epsilon <= 1, "ticket.epsilon", "a number in [0, 1]", self.epsilon)


@dataclass(frozen=True)
class TicketRequest:
    """An actor asks what to do next; the same nonce always gets the same answer."""

    actor: str
    incarnation: str
    nonce: str
    gives_back: tuple[int, int] | None = None
    """Index and attempt of a ticket that the actor cannot play."""

    def __post_init__(self) -> None:
        require_id("ticket_request.actor", self.actor)
        require_id("ticket_request.incarnation", self.incarnation)
        require_id("ticket_request.nonce", self.nonce)


class Instruction(StrEnum):
    """What an actor is to do."""

    COLLECT = "collect"
    WAIT = "wait"
    """Nothing to collect now: ask again."""
    DRAIN = "drain"
    """Deliver what is spooled, then leave."""
    STOP = "stop"
    """The run has ended: deliver what is spooled, then leave."""


@dataclass(frozen=True)
class TicketReply:
    """The owner's answer to a ticket request."""

    instruction: Instruction
    nonce: str
    owner_epoch: int
    ticket: Ticket | None = None

    def __post_init__(self) -> None:
        has_ticket = self.ticket is not None
        is_collect = self.instruction is Instruction.COLLECT
        _require(
            has_ticket == is_collect, "ticket_reply.ticket", "one exactly with 'collect'", self
        )


# Trajectories ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrajectoryId:
    """Names a trajectory for good: a resend carries the same id."""

    actor: str
    incarnation: str
    """Of the actor's process that acted; a restarted actor has another."""
    sequence: int
    """Counts the trajectories of an actor's spool."""

    def __post_init__(self) -> None:
        require_id("trajectory_id.actor", self.actor)
        require_id("trajectory_id.incarnation", self.incarnation)
        _require_count("trajectory_id.sequence", self.sequence)

    def __str__(self) -> str:
        return f"{self.actor}/{self.incarnation}/{self.sequence}"


@dataclass(frozen=True)
class Trajectory:
    """What happened: T steps between T + 1 observations."""

    id: TrajectoryId
    ticket: Ticket
    observations: NDArray[np.uint8]
    """u8[T+1, H, W, C]."""
    actions: NDArray[np.int32]
    """i32[T]."""
    rewards: NDArray[np.float32]
    """f32[T], finite."""
    terminated: bool
    """The last state ends the task: no value is bootstrapped from it."""
    truncated: bool
    """The episode ended for another reason: horizon, guard, crash."""
    success: bool
    """Whether the task counts as solved in the last state."""
    guard: str | None
    """Why the environment's guard ended the attempt; such an attempt is never learned from."""
    interrupted: bool
    """The actor died in mid-episode: only the finished steps are here."""
    ended_unix_secs: float
    """Wall clock of the actor's host at the end; for people, never for ordering."""

    def __post_init__(self) -> None:
        steps = len(self.actions)
        _require(steps >= 1, "trajectory.actions", "at least one step", f"{steps} steps")
        subject = "trajectory.observations"
        _require_array(subject, self.observations, "uint8", (steps + 1, None, None, None))
        _require_array("trajectory.actions", self.actions, "int32", (steps,))
        _require_array("trajectory.rewards", self.rewards, "float32", (steps,))
        finite = bool(np.isfinite(self.rewards).all())
        _require(finite, "trajectory.rewards", "finite numbers", self.rewards.tolist())
        smallest = int(self.actions.min())
        _require(smallest >= 0, "trajectory.actions", "indices of 0 or more", smallest)
        _require(
            math.isfinite(self.ended_unix_secs),
            "trajectory.ended_unix_secs",
            "a finite time",
            self.ended_unix_secs,
        )

    @property
    def steps(self) -> int:
        """T."""
        return len(self.actions)

    @property
    def return_(self) -> float:
        """Sum of the rewards, undiscounted."""
        return float(np.sum(self.rewards, dtype=np.float64))

    def check_fits(self, spec: NetworkSpec) -> None:
        """Refuses a trajectory that a network of this spec cannot learn from.

        Raises:
            MessageError: Picture shape or an action index differs from the spec's.
        """
        got = self.observations.shape[1:]
        if got != tuple(spec.observation_shape):
            raise MessageError(
                f"trajectory.observations: expected uint8 [T+1, "
                f"{', '.join(map(str, spec.observation_shape))}]; got uint8 "
                f"{list(self.observations.shape)} from {self.id.actor}; "
                "actor and learner run different presets"
            )
        largest = int(self.actions.max())
        if largest >= spec.n_actions:
            raise MessageError(
                f"trajectory.actions: expected indices below {spec.n_actions}; got {largest} from "
                f"{self.id.actor}; actor and learner run different presets"
            )


class Verdict(StrEnum):
    """What became of an attempt."""

    ACCEPTED = "accepted"
    """Enters the memory."""
    SPARE = "spare"
    """Sound, but another attempt of the ticket was complete first."""
    INVALID = "invalid"
    """Guarded, or of a wrong length; kept, never learned from. The ticket is issued again."""
    UNASKED = "unasked"
    """Of a ticket that was not issued like this; kept, and changes nothing."""
    LOST = "lost"
    """The actor vanished; the ticket is issued again."""


@dataclass(frozen=True)
class Ack:
    """The owner has committed a trajectory to its journal."""

    id: TrajectoryId
    owner_epoch: int
    offset: int
    """Where in the journal it is."""
    verdict: Verdict
    duplicate: bool
    """It was there already; nothing was added."""

    def __post_init__(self) -> None:
        _require_count("ack.offset", self.offset)


# Policies -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Snapshot:
    """A policy, by version."""

    version: int
    """Updates made so far; 0 is the policy before the first episode."""
    owner_epoch: int
    network: NetworkSpec
    weights: bytes
    """safetensors."""
    digest: str
    """SHA-256 of `weights`."""

    def __post_init__(self) -> None:
        _require_count("snapshot.version", self.version)
        _require_digest("snapshot.digest", self.digest)
        actual = weights_digest(self.weights)
        _require(self.digest == actual, "snapshot.digest", f"{actual} (of weights)", self.digest)


def weights_digest(weights: bytes) -> str:
    """SHA-256 of safetensors bytes, in hexadecimal."""
    return hashlib.sha256(weights).hexdigest()


@dataclass(frozen=True)
class SnapshotRequest:
    """An actor asks for exactly one version."""

    version: int

    def __post_init__(self) -> None:
        _require_count("snapshot_request.version", self.version)


# The journal ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class JournalRequest:
    """A follower asks for the entries from an offset on."""

    offset: int
    max_bytes: int
    """A batch ends before it is larger than this, but holds one entry if there is any."""

    def __post_init__(self) -> None:
        _require_count("journal_request.offset", self.offset)
        _require(self.max_bytes >= 1, "journal_request.max_bytes", "at least 1", self.max_bytes)


@dataclass(frozen=True)
class JournalEntry:
    """One entry of the journal as it is stored."""

    offset: int
    name: str
    """Unique in the journal; appending the same name again adds nothing."""
    payload: bytes
    """An encoded message."""


@dataclass(frozen=True)
class JournalBatch:
    """Consecutive entries."""

    owner_epoch: int
    entries: tuple[JournalEntry, ...]
    end_offset: int
    """One past the newest entry at the time of the answer: how far the follower is behind."""


@dataclass(frozen=True)
class RunStarted:
    """Journal: an owner took the run; the first entry of every journal, and of every restart."""

    run: str
    owner_epoch: int
    preset_json: str
    software_version: str


@dataclass(frozen=True)
class TicketIssued:
    """Journal: an attempt was handed to an actor."""

    ticket: Ticket
    actor: str
    incarnation: str
    nonce: str


@dataclass(frozen=True)
class AttemptEnded:
    """Journal: an attempt came to its end."""

    ticket: int
    attempt: int
    verdict: Verdict
    trajectory: TrajectoryId | None
    """None when the attempt was lost."""
    steps: int
    is_last_part: bool
    """With `accepted`: the ticket is complete."""
    reason: str
    """Why, for a person; empty when accepted."""


@dataclass(frozen=True)
class TicketReseeded:
    """Journal: the ticket's attempts failed too often; its seed was void and is replaced."""

    ticket: int
    generation: int
    """Counts the replaced seeds."""


@dataclass(frozen=True)
class SnapshotTaken:
    """Journal: a policy version exists."""

    version: int
    digest: str
    tickets_absorbed: int
    """Tickets that were in the memory when it was trained."""


@dataclass(frozen=True)
class IterationEnded:
    """Journal: an iteration's episodes are in the memory and learned from."""

    iteration: int
    digest: str
    """SHA-256 over the ids of its accepted trajectories, in ticket order."""
    mean_return: float
    success_rate: float


# Control --------------------------------------------------------------------------------------


class Command(StrEnum):
    """What a person may ask of a run."""

    PAUSE = "pause"
    """Issue no tickets until `resume`."""
    RESUME = "resume"
    DRAIN = "drain"
    """The named actor delivers and leaves; without a name, all of them."""
    STOP = "stop"
    """Checkpoint and end."""


@dataclass(frozen=True)
class Control:
    """A person steers the run."""

    command: Command
    actor: str | None = None
    """For `drain`."""


@dataclass(frozen=True)
class ControlReply:
    """The owner did as asked."""

    command: Command
    state: str
    """The run's state after it."""
