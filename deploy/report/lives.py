"""Who was alive when: told from signs of life and, where a recorder heard them, from presence."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from broker_config.messages import Presence, Role

Process = tuple[Role, str]
"""Role and id."""

_LATE_SECS: Final = 5.0
"""A sign may be noted so long after its sender's end was: a ticket for who has just died."""
_ROLE_ORDER: Final[Sequence[Role]] = ("owner", "discriminator", "evaluator", "recorder", "actor")


@dataclass(frozen=True)
class Life:
    """A process from its start to its end, as far as anybody noticed."""

    role: Role
    id: str
    began_secs: float
    """Wall clock of whoever noticed: the owner or the recorder."""
    ended_secs: float
    was_seen_to_end: bool
    """Otherwise this is merely when it was last heard of."""


@dataclass
class _Signs:
    first_secs: float
    last_secs: float


class LifeBook:
    """Folds signs of life; it holds two numbers for each start of a process.

    A sign names an incarnation: another one is another life. Presence names none, but tells to the
    moment when somebody came or went; recorders hear of it only while they live themselves.
    """

    def __init__(self) -> None:
        self._signs: defaultdict[Process, dict[str, _Signs]] = defaultdict(dict)
        self._came: defaultdict[Process, list[float]] = defaultdict(list)
        self._went: defaultdict[Process, list[float]] = defaultdict(list)
        self._present: set[Process] = set()
        """That came, and did not go as far as anybody heard."""
        self._confirmed: set[Process] = set()
        """Of these, the ones that the newest recorder has heard of."""
        self._heard_until_secs = float("-inf")

    def sign(self, role: Role, id_: str, incarnation: str, unix_secs: float) -> None:
        """A process did something."""
        signs = self._signs[role, id_].setdefault(incarnation, _Signs(unix_secs, unix_secs))
        signs.first_secs = min(signs.first_secs, unix_secs)
        signs.last_secs = max(signs.last_secs, unix_secs)

    def presence(self, presence: Presence, unix_secs: float) -> None:
        """A process came or went; a recorder that starts hears of all who are there once more."""
        process = presence.role, presence.id
        self.heard_until(unix_secs)
        if not presence.is_alive:
            self._present.discard(process)
            self._confirmed.discard(process)
            self._went[process].append(unix_secs)
            return
        self._confirmed.add(process)
        if process not in self._present:
            self._present.add(process)
            self._came[process].append(unix_secs)

    def recorder_started(self) -> None:
        """Whoever lives will be heard of again; the others went while nobody recorded."""
        self._confirmed.clear()

    def heard_until(self, unix_secs: float) -> None:
        """A recorder wrote something: whoever it knew to be present was so until then."""
        self._heard_until_secs = max(self._heard_until_secs, unix_secs)

    def starts(self, role: Role) -> int:
        """Of all processes of a role, as far as they gave signs of life."""
        return sum(len(its) for (its_role, _), its in self._signs.items() if its_role == role)

    def starts_of(self, process: Process) -> int:
        """Of one process."""
        return len(self._signs.get(process, ()))

    @property
    def lives(self) -> list[Life]:
        """All of them: owner first, actors last, each process's in order of time."""
        found = [life for process in self._signs for life in self._lives_of(process)]
        for process in self._came.keys() - self._signs.keys():
            found += self._lives_by_presence(process)
        return sorted(found, key=lambda it: (_rank(it.role), it.role, it.id, it.began_secs))

    def _lives_of(self, process: Process) -> list[Life]:
        signs = sorted(self._signs[process].values(), key=lambda it: it.first_secs)
        lives, ended_before = [], float("-inf")
        for number, sign in enumerate(signs):
            is_newest = number == len(signs) - 1
            next_secs = float("inf") if is_newest else signs[number + 1].first_secs
            came = [it for it in self._came[process] if ended_before < it <= sign.first_secs]
            earliest = max(sign.first_secs, sign.last_secs - _LATE_SECS)
            went = [it for it in self._went[process] if earliest <= it <= next_secs]
            ended_secs = min(went, default=sign.last_secs)
            if is_newest and not went and process in self._confirmed:
                ended_secs = max(ended_secs, self._heard_until_secs)
            # The newest one that came: whoever came earlier in between left no sign.
            began_secs = max(came, default=sign.first_secs)
            lives.append(Life(*process, began_secs, ended_secs, bool(went)))
            ended_before = ended_secs
        return lives

    def _lives_by_presence(self, process: Process) -> list[Life]:
        moments = sorted(
            [(at, True) for at in self._came[process]] + [(at, False) for at in self._went[process]]
        )
        lives: list[Life] = []
        began_secs: float | None = None
        for at, is_alive in moments:
            if is_alive:
                began_secs = at
            elif began_secs is not None:
                lives.append(Life(*process, began_secs, at, was_seen_to_end=True))
                began_secs = None
        if began_secs is not None:
            is_present = process in self._confirmed
            ended_secs = self._heard_until_secs if is_present else moments[-1][0]
            lives.append(Life(*process, began_secs, ended_secs, was_seen_to_end=False))
        return lives


def _rank(role: Role) -> int:
    return _ROLE_ORDER.index(role) if role in _ROLE_ORDER else len(_ROLE_ORDER)
