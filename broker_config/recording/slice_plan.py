"""Which messages of a recording belong to a part of it: found from its journal alone.

An episode is its ticket with every attempt at it: what was issued, the trajectories, what became of
them, and the policy that acted, with its weights. An iteration is its episodes, its announced
samples, their rewards, and its end. Whatever else lies between the first and the last of these
(metrics, presence, noted gaps) is in the part; views are, if they are of its episodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from broker_config.codec import decode, decode_any
from broker_config.errors import MessageError, StorageError
from broker_config.messages import (
    AttemptEnded,
    JournalEntry,
    RunStarted,
    SnapshotTaken,
    TicketIssued,
    TicketReseeded,
)
from broker_config.preset import preset_from_json
from broker_config.recording.format import JOURNAL_PREFIX
from broker_config.recording.reader import iter_segment
from broker_config.recording.records import DamagedSegment

_NS_PER_SEC = 1_000_000_000


@dataclass(frozen=True)
class Selection:
    """A part of a recording: by one of time, episodes and iterations, and of it some topics."""

    secs: tuple[float, float] | None = None
    """From and up to, since the first message, by the recorder's clock; infinite where open."""
    episodes: range | None = None
    """Tickets, counted from 0."""
    iterations: range | None = None
    """Counted from 0, as in the journal."""
    topics: tuple[str, ...] | None = None
    """As `iter_recording` has them; all if None."""

    @property
    def words(self) -> str:
        """The part, for a person."""
        words = []
        if self.secs is not None:
            words.append(f"seconds {self.secs[0]:g} to {self.secs[1]:g}")
        for name, chosen in (("episodes", self.episodes), ("iterations", self.iterations)):
            if chosen is not None:
                last = "" if len(chosen) == 1 else f"-{chosen.stop - 1}"
                words.append(f"{name} {chosen.start}{last}")
        if self.topics is not None:
            words.append(f"topics {', '.join(self.topics)}")
        return "; ".join(words) or "everything"


@dataclass
class SlicePlan:
    """What is to be copied."""

    selection: Selection
    window_ns: tuple[float, float] | None = None
    """By the recorder's clock; None where the part is not chosen by time."""
    tickets: range = range(0)
    """The episodes of a part that is chosen by them, or by iterations."""
    span: tuple[int, int] | None = None
    """First and last journal entry of the part; None by time."""
    offsets: set[int] = field(default_factory=set)
    """Of journal entries; by time, only of those outside it which belong to those within."""
    versions: set[int] = field(default_factory=set)
    """Of policies whose weights belong to it."""
    there_is: str = ""
    """What the recording has, for a person who asked for something else."""


def plan_slice(
    paths: list[Path], selection: Selection, on_bytes: Callable[[int], None] = lambda _: None
) -> SlicePlan:
    """Reads the journal of a recording.

    Raises:
        StorageError: The recording is damaged or not finished; or the part is by episodes or
            iterations, and there are none such in it.
    """
    reader = _JournalReading(selection, _first_ns(paths[0]))
    for path in paths:
        for _, _, message in iter_segment(path, [JOURNAL_PREFIX], on_bytes):
            try:
                reader.take(decode(message.data, JournalEntry), message.log_time)
            except MessageError as error:
                raise DamagedSegment(path, f"an entry that cannot be read ({error})") from error
    return reader.plan()


def _first_ns(path: Path) -> int:
    for _, _, message in iter_segment(path):
        return message.log_time
    raise DamagedSegment(path, "no message")


@dataclass(frozen=True)
class _Placed:
    """An entry, and whether it is chosen by time."""

    offset: int
    is_within: bool


class _JournalReading:
    """Takes the journal's entries in order.

    In memory are attempts under way, a number for each policy version, and the entries of the part
    (by time, only those outside it).
    """

    def __init__(self, selection: Selection, first_ns: int) -> None:
        self._selection = selection
        self._plan = SlicePlan(selection)
        self._is_by_time = selection.episodes is None and selection.iterations is None
        if self._is_by_time:
            begin, end = selection.secs or (-math.inf, math.inf)
            self._plan.window_ns = (first_ns + begin * _NS_PER_SEC, first_ns + end * _NS_PER_SEC)
        self._plan.tickets = selection.episodes or range(0)
        self._part = _Bounds()
        self._tickets = _Bounds()
        self._times_ns = _Bounds(first_ns, first_ns)
        self._runs: list[int] = []
        self._taken: dict[int, int] = {}
        """Offset of the entry that names a version."""
        self._issued: dict[tuple[int, int], tuple[_Placed, int]] = {}
        """Attempts under way: their entry, and the policy version."""
        self._arrived: dict[str, _Placed] = {}
        """Trajectories whose verdict comes next."""

    def take(self, entry: JournalEntry, log_time_ns: int) -> None:
        self._times_ns.note(log_time_ns)
        window = self._plan.window_ns
        is_within = window is not None and window[0] <= log_time_ns < window[1]
        place = _Placed(entry.offset, is_within)
        if is_within:
            self._part.note(entry.offset)
        sort, _, rest = entry.name.partition("/")
        match sort:
            case "trajectory":
                self._arrived[rest] = place
            case "announced" | "rewards" | "iteration":
                if int(rest) in (self._selection.iterations or ()):
                    self._keep(place)
            case "run" | "ticket" | "ended" | "lost" | "reseeded" | "snapshot":
                self._take_message(decode_any(entry.payload), place)

    def _take_message(self, message: object, place: _Placed) -> None:
        match message:
            case RunStarted():
                self._runs.append(place.offset)
                self._choose_tickets(message)
            case SnapshotTaken():
                self._taken[message.version] = place.offset
                if place.is_within:
                    self._plan.versions.add(message.version)
            case TicketIssued():
                self._issue(message, place)
            case AttemptEnded():
                self._end(message, place)
            case TicketReseeded() if message.ticket in self._plan.tickets:
                self._keep(place)

    def _choose_tickets(self, started: RunStarted) -> None:
        if (iterations := self._selection.iterations) is not None:
            each = preset_from_json(started.preset_json).schedule.episodes_per_iteration
            self._plan.tickets = range(iterations.start * each, iterations.stop * each)

    def _issue(self, issued: TicketIssued, place: _Placed) -> None:
        ticket = issued.ticket
        self._tickets.note(ticket.index)
        is_chosen = ticket.index in self._plan.tickets
        if is_chosen or place.is_within:
            self._keep(place)
            self._plan.versions.add(ticket.policy_version)
        if is_chosen or self._is_by_time:
            self._issued[ticket.index, ticket.attempt] = place, ticket.policy_version

    def _end(self, ended: AttemptEnded, place: _Placed) -> None:
        """An attempt is in the part by its ticket, or if its end or its trajectory is."""
        issued = self._issued.pop((ended.ticket, ended.attempt), None)
        arrived = self._arrived.pop(str(ended.trajectory), None)
        is_within = place.is_within or (arrived is not None and arrived.is_within)
        if not (is_within or ended.ticket in self._plan.tickets):
            return
        self._keep(place)
        if arrived is not None:
            self._keep(arrived)
        if issued is not None:
            self._keep(issued[0])
            self._plan.versions.add(issued[1])

    def _keep(self, place: _Placed) -> None:
        self._part.note(place.offset)
        if not place.is_within:
            self._plan.offsets.add(place.offset)

    def plan(self) -> SlicePlan:
        """The plan, once all was taken."""
        plan = self._plan
        secs = (self._times_ns.most - self._times_ns.least) / _NS_PER_SEC
        plan.there_is = f"episodes {self._tickets} in {secs:.1f} s"
        if not self._is_by_time:
            if not self._part:
                raise StorageError(
                    f"slice: expected {self._selection.words} in the recording; got none of them; "
                    f"it has {plan.there_is}"
                )
            plan.span = self._part.least, self._part.most
        plan.offsets.update(self._taken[it] for it in plan.versions if it in self._taken)
        first = self._runs[:1]  # it has the preset
        plan.offsets.update(first + [it for it in self._runs if it < self._part.most])
        return plan


class _Bounds:
    """The smallest and the largest of some numbers."""

    def __init__(self, least: int = 0, most: int = -1) -> None:
        self.least = least
        self.most = most

    def __bool__(self) -> bool:
        return self.most >= self.least

    def __str__(self) -> str:
        return f"{self.least} to {self.most}" if self else "none"

    def note(self, number: int) -> None:
        self.least = min(number, self.least) if self else number
        self.most = max(number, self.most)
