"""Key expressions: built and parsed here, and nowhere else.

Segments in angle brackets are filled in; every other segment stands for itself. A run is one key
segment, so that one router carries many runs and `*/live/owner/*` finds them all.
"""

from __future__ import annotations

import typing
from dataclasses import dataclass
from enum import StrEnum

from broker_config.errors import MessageError
from broker_config.messages import Role, require_id


class Kind(StrEnum):
    """What a key is for; the value is its template."""

    ATTACH = "<run>/attach/<role>/<id>"
    TICKET = "<run>/ticket/<actor>"
    TRAJECTORY = "<run>/trajectory/<actor>"
    JOURNAL = "<run>/journal/<role>/<id>"
    REWARDS = "<run>/rewards/<discriminator>"
    DISCRIMINATORS = "<run>/discriminators"
    POLICY = "<run>/policy"
    POLICY_VERSION = "<run>/policy/<version>"
    METRICS = "<run>/metrics/<role>/<id>"
    VIEW = "<run>/view/<actor>"
    LIVE = "<run>/live/<role>/<id>"
    CONTROL = "<run>/control"


ROLES: tuple[Role, ...] = typing.get_args(Role)

ALL_OWNERS = "*/live/owner/*"
"""Matches the liveliness token of the owner of every run that a router carries."""

_BY_SHAPE = {(kind.split("/")[1], kind.count("/")): kind for kind in Kind}
_MAX_VERSION_DIGITS = 19


@dataclass(frozen=True)
class ParsedKey:
    """A key, taken apart."""

    run: str
    kind: Kind
    role: Role | None = None
    """Of the process that the key belongs to; where the template has none, the template says it:
    `<actor>`, `<discriminator>`."""
    id: str | None = None
    """Of the process that the key belongs to."""
    version: int | None = None
    """With `policy/<version>`."""

    def __str__(self) -> str:
        """The key itself."""
        values = {
            "<run>": self.run,
            "<role>": self.role,
            "<id>": self.id,
            "<actor>": self.id,
            "<discriminator>": self.id,
            "<version>": self.version,
        }
        return "/".join(str(values.get(segment, segment)) for segment in self.kind.split("/"))


@dataclass(frozen=True)
class RunKeys:
    """Builds the keys of one run.

    Raises:
        MessageError: The run, or an id given to a method, cannot be part of a key.
    """

    run: str

    def __post_init__(self) -> None:
        require_id("run", self.run)

    def attach(self, role: Role, process_id: str) -> str:
        """Where a process asks whether it may join."""
        return self._of_process(Kind.ATTACH, role, process_id)

    def ticket(self, actor: str) -> str:
        """Where an actor asks for its next ticket."""
        return self._of_process(Kind.TICKET, "actor", actor)

    def trajectory(self, actor: str) -> str:
        """Where an actor delivers."""
        return self._of_process(Kind.TRAJECTORY, "actor", actor)

    def journal(self, role: Role, process_id: str) -> str:
        """Where a follower pulls the journal."""
        return self._of_process(Kind.JOURNAL, role, process_id)

    def rewards(self, discriminator: str) -> str:
        """Where a discriminator service delivers an iteration's rewards."""
        return self._of_process(Kind.REWARDS, "discriminator", discriminator)

    @property
    def discriminators(self) -> str:
        """Where the newest discriminators are published."""
        return str(ParsedKey(self.run, Kind.DISCRIMINATORS))

    @property
    def policy(self) -> str:
        """Where the newest snapshot is published."""
        return str(ParsedKey(self.run, Kind.POLICY))

    def policy_version(self, version: int) -> str:
        """Where exactly one version is asked for."""
        if not 0 <= version < 2**63:
            raise MessageError(f"version: expected a count of 0 or more; got {version}")
        return str(ParsedKey(self.run, Kind.POLICY_VERSION, version=version))

    def metrics(self, role: Role, process_id: str) -> str:
        """Where a process publishes its numbers."""
        return self._of_process(Kind.METRICS, role, process_id)

    def view(self, actor: str) -> str:
        """Where an actor shows what it sees."""
        return self._of_process(Kind.VIEW, "actor", actor)

    def live(self, role: Role, process_id: str) -> str:
        """A process's liveliness token, and its heartbeat."""
        return self._of_process(Kind.LIVE, role, process_id)

    @property
    def control(self) -> str:
        """Where a person steers the run."""
        return str(ParsedKey(self.run, Kind.CONTROL))

    def every(self, kind: Kind) -> str:
        """The pattern that matches every key of a kind in this run, for servers and subscribers."""
        _, *rest = kind.split("/")
        return "/".join([self.run, *("*" if segment[0] == "<" else segment for segment in rest)])

    def _of_process(self, kind: Kind, role: str, process_id: str) -> str:
        checked = require_id(f"{kind.split('/')[1]} key", process_id)
        return str(ParsedKey(self.run, kind, _require_role(role), checked))


def parse_key(key: str) -> ParsedKey:
    """Takes a key apart.

    Raises:
        MessageError: It is a pattern, or no key of the contract.
    """
    segments = key.split("/")
    shape = (segments[1] if len(segments) > 1 else "", len(segments) - 1)
    kind = _BY_SHAPE.get(shape)
    if kind is None:
        known = ", ".join(Kind)
        raise MessageError(f"key: expected one of {known}; got {_shown(key)}")
    run = require_id("key's run", segments[0])
    if kind is Kind.POLICY_VERSION:
        return ParsedKey(run, kind, version=_parse_version(segments[2], key))
    if kind.count("/") == 3:
        return ParsedKey(run, kind, _require_role(segments[2]), require_id("key's id", segments[3]))
    if kind.count("/") == 2:
        role = _require_role(kind.rpartition("/")[2].strip("<>"))
        return ParsedKey(run, kind, role, require_id(f"key's {role}", segments[2]))
    return ParsedKey(run, kind)


def _parse_version(segment: str, key: str) -> int:
    is_canonical = segment.isascii() and segment.isdigit() and segment == segment.lstrip("0")
    if (segment != "0" and not is_canonical) or len(segment) > _MAX_VERSION_DIGITS:
        raise MessageError(f"key's version: expected a count of 0 or more; got {_shown(key)}")
    return int(segment)


def _require_role(role: str) -> Role:
    found = next((known for known in ROLES if known == role), None)
    if found is None:
        raise MessageError(f"key's role: expected one of {', '.join(ROLES)}; got {_shown(role)}")
    return found


def _shown(text: str) -> str:
    return repr(text if len(text) <= 80 else text[:77] + "...")
