"""What must hold between the messages of a recording; each rule sees all of them, once, in order.

All remember little: what still waits for its counterpart, and a digest for each policy version.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from hashlib import sha256

from broker_config.codec import decode_any
from broker_config.errors import MessageError, PresetError
from broker_config.journal import JournalReader
from broker_config.messages import (
    AttemptEnded,
    Control,
    DemonstrationsBegun,
    FollowerJoined,
    IterationAnnounced,
    IterationEnded,
    JournalEntry,
    Metrics,
    RecorderStarted,
    RecordingGap,
    Rewards,
    RunStarted,
    Snapshot,
    SnapshotTaken,
    TargetsMarked,
    TicketIssued,
    TicketReseeded,
    Trajectory,
    TrajectoryId,
    View,
)
from broker_config.preset import preset_from_json
from broker_config.recording.findings import Extent, Finding, Heard, Rule
from broker_config.recording.format import (
    POLICY_GAP_PREFIX,
    Facts,
    journal_topic,
    policy_gap_key,
    topic_of,
)
from broker_config.specs import NetworkSpec

SORTS: dict[str, type] = {
    journal_topic(sort): kind
    for sort, kind in {
        "run": RunStarted,
        "demonstration": Trajectory,
        "demonstrator": DemonstrationsBegun,
        "target": TargetsMarked,
        "ticket": TicketIssued,
        "trajectory": Trajectory,
        "ended": AttemptEnded,
        "lost": AttemptEnded,
        "reseeded": TicketReseeded,
        "snapshot": SnapshotTaken,
        "announced": IterationAnnounced,
        "rewards": Rewards,
        "iteration": IterationEnded,
        "control": Control,
        "follower": FollowerJoined,
    }.items()
}
"""The message in a journal entry, by the topic of its sort, as `learner.owner` lists them."""


class Placed(Rule):
    """Each message lies under its topic, and each entry holds what its name says."""

    def _hear(self, heard: Heard) -> Iterator[Finding]:
        message = heard.message
        if (topic := topic_of(message)) != heard.topic:
            name = type(message).__name__
            yield Finding(f"expected topic {topic} for a {name}; got {heard.topic}")
        if not isinstance(message, JournalEntry):
            return
        expected = SORTS.get(heard.topic)
        if heard.entry is not None and expected not in (None, type(heard.entry)):
            yield Finding(
                f"journal entry {message.offset}, {message.name}: expected "
                f"{expected.__name__ if expected else 'a message'}; got "
                f"{type(heard.entry).__name__}"
            )


class EntriesInOrder(Rule):
    """Every journal entry is there, once, in order; each recorder goes on where the last ended."""

    def __init__(self, extent: Extent) -> None:
        super().__init__(extent)
        self.next_offset: int | None = 0 if extent.begins_at_0 else None

    def _hear(self, heard: Heard) -> Iterator[Finding]:
        match heard.message:
            case RecorderStarted() as started:
                yield from self._hear_start(started)
            case JournalEntry() as entry:
                yield from self._hear_entry(entry, heard.sequence)

    def _hear_start(self, started: RecorderStarted) -> Iterator[Finding]:
        if self.next_offset is None:
            self.next_offset = started.next_offset
        elif self._extent.slice_ is None and started.next_offset != self.next_offset:
            yield Finding(
                f"expected a segment that goes on with journal entry {self.next_offset}; got one "
                f"that begins with {started.next_offset}"
            )

    def _hear_entry(self, entry: JournalEntry, sequence: int) -> Iterator[Finding]:
        expected = entry.offset if self.next_offset is None else self.next_offset
        if entry.offset < expected:
            yield Finding(f"expected journal entry {expected}; got {entry.offset} once more")
        elif entry.offset > expected and self._extent.slice_ is None:
            missing = entry.offset - expected
            yield Finding(
                f"expected journal entry {expected}; got {entry.offset}: {missing} missing"
            )
        if sequence != entry.offset % 2**32:
            yield Finding(f"journal entry {entry.offset}: expected its offset; got {sequence}")
        self.next_offset = max(expected, entry.offset + 1)


class WeightsThere(Rule):
    """Each policy version that the journal names has its weights before it, of the digest."""

    def __init__(self, extent: Extent) -> None:
        super().__init__(extent)
        self._digests: dict[int, str] = {}
        self._gone: set[str] = set()

    def _hear(self, heard: Heard) -> Iterator[Finding]:
        match heard.message:
            case Snapshot() as snapshot:
                self._digests[snapshot.version] = snapshot.digest
            case RecordingGap() as gap if gap.key.startswith(POLICY_GAP_PREFIX):
                self._gone.add(gap.key)
        if isinstance(heard.entry, SnapshotTaken):
            yield from self._compare(heard.entry)

    def _compare(self, taken: SnapshotTaken) -> Iterator[Finding]:
        found = self._digests.get(taken.version)
        if found == taken.digest:
            return
        expected = f"policy version {taken.version}: expected weights of digest {taken.digest[:16]}"
        if policy_gap_key(taken.version) in self._gone:
            yield Finding(f"{expected}; the recorder notes that they were gone", is_fault=False)
        elif found is not None:
            yield Finding(f"{expected}; got {found[:16]}")
        elif self._extent.has_weights:
            yield Finding(f"{expected}; got none")
        else:
            yield Finding(f"{expected}; they are not in this part", is_fault=False)


class TrajectoriesFit(Rule):
    """Trajectories and policies are of the preset's network; each has its verdict behind it.

    Demonstrations are made, not judged: they have none.
    """

    def __init__(self, extent: Extent) -> None:
        super().__init__(extent)
        self._network: NetworkSpec | None = None
        self._arrived: TrajectoryId | None = None
        self._are_judged = True

    def _hear(self, heard: Heard) -> Iterator[Finding]:
        match heard.content:
            case RunStarted(run=run, preset_json=preset_json):
                yield from self._hear_preset(f"run {run}", preset_json)
            case DemonstrationsBegun(preset_json=preset_json):
                self._are_judged = False
                yield from self._hear_preset("demonstrations", preset_json)
            case Trajectory() as trajectory:
                yield from self._fit(trajectory)
                if heard.topic == journal_topic("trajectory"):
                    yield from self._unjudged()
                    self._arrived = trajectory.id
            case AttemptEnded(trajectory=TrajectoryId() as id_):
                if self._extent.is_whole and id_ != self._arrived:
                    yield Finding(f"verdict on trajectory {id_}: expected it before; it is not")
                self._arrived = None
            case Snapshot() as snapshot if self._network not in (None, snapshot.network):
                yield Finding(
                    f"policy version {snapshot.version}: expected the preset's network, "
                    f"{self._network}; got {snapshot.network}"
                )

    def _end(self) -> Iterator[Finding]:
        for finding in self._unjudged():
            yield replace(finding, is_fault=False)  # its recorder may have been stopped there

    def _hear_preset(self, whose: str, preset_json: str) -> Iterator[Finding]:
        try:
            self._network = preset_from_json(preset_json).network
        except PresetError as error:
            yield Finding(f"{whose}: expected a preset; got one that is none ({error})")

    def _fit(self, trajectory: Trajectory) -> Iterator[Finding]:
        if self._network is None:
            return
        try:
            trajectory.check_fits(self._network)
        except MessageError as error:
            yield Finding(f"trajectory {trajectory.id}: {error}")

    def _unjudged(self) -> Iterator[Finding]:
        if self._arrived is not None and self._are_judged and self._extent.is_whole:
            yield Finding(f"trajectory {self._arrived}: expected its verdict behind it; got none")


class RewardsBelong(Rule):
    """Each announced iteration gets its rewards, of the samples that were announced."""

    def __init__(self, extent: Extent) -> None:
        super().__init__(extent)
        self._announced: IterationAnnounced | None = None

    def _hear(self, heard: Heard) -> Iterator[Finding]:
        match heard.entry:
            case IterationAnnounced() as announced:
                yield from self._unrewarded(is_fault=self._extent.is_whole)
                self._announced = announced
            case Rewards() as rewards:
                yield from self._compare(rewards)
                self._announced = None

    def _end(self) -> Iterator[Finding]:
        yield from self._unrewarded(is_fault=False)  # it may have been the run's last act

    def _unrewarded(self, *, is_fault: bool) -> Iterator[Finding]:
        if self._announced is not None:
            number = self._announced.iteration
            yield Finding(f"iteration {number}: expected rewards once announced; none", is_fault)

    def _compare(self, rewards: Rewards) -> Iterator[Finding]:
        subject, announced = f"rewards of iteration {rewards.iteration}", self._announced
        if announced is None or announced.iteration != rewards.iteration:
            if self._extent.is_whole:
                yield Finding(f"{subject}: expected them to be announced before; they are not")
            return
        if rewards.digest != announced.digest:
            yield Finding(
                f"{subject}: expected those of D_G {announced.digest[:16]}; got "
                f"{rewards.digest[:16]}"
            )
        if len(rewards.rewards) != announced.samples:
            yield Finding(f"{subject}: expected {announced.samples}; got {len(rewards.rewards)}")


class SendersCounted(Rule):
    """What is missing of views and metrics is noted as a gap."""

    def __init__(self, extent: Extent) -> None:
        super().__init__(extent)
        self._facts = Facts()
        self._missing: Counter[str] = Counter()

    def _hear(self, heard: Heard) -> Iterator[Finding]:
        match heard.message:
            case View() | Metrics() as message if self._extent.slice_ is None:
                yield from self._compare(heard.topic, message)
            case RecordingGap() as gap:
                self._missing[gap.key] += gap.missing
        self._facts.note(heard.message)

    def _end(self) -> Iterator[Finding]:
        for key, missing in sorted(self._missing.items()):
            if not key.startswith(POLICY_GAP_PREFIX):
                yield Finding(f"{missing} messages of {key} were dropped, as noted", is_fault=False)

    def _compare(self, topic: str, message: View | Metrics) -> Iterator[Finding]:
        is_known = f"{topic} {message.incarnation}" in self._facts.next_sequences
        if not (is_known or self._extent.begins_at_0):
            return
        expected = self._facts.expected_sequence(topic, message.incarnation)
        if message.sequence != expected:
            yield Finding(
                f"{topic} of {message.incarnation}: expected message {expected}, or a gap to be "
                f"noted; got {message.sequence}"
            )


class RecordersNamed(Rule):
    """One run, and who recorded it."""

    def __init__(self, extent: Extent) -> None:
        super().__init__(extent)
        self._run: str | None = None
        self._lives: set[str] = set()

    def _hear(self, heard: Heard) -> Iterator[Finding]:
        match heard.content:
            case RecorderStarted() as started:
                yield from self._compare(started.run)
                if started.incarnation not in self._lives:
                    self._lives.add(started.incarnation)
                    yield Finding(
                        f"recorder {started.incarnation} (clothbus {started.software_version}) "
                        f"began with journal entry {started.next_offset}",
                        is_fault=False,
                    )
            case RunStarted() as run:
                yield from self._compare(run.run)

    def _compare(self, run: str) -> Iterator[Finding]:
        if self._run is None:
            self._run = run
        elif run != self._run:
            yield Finding(f"expected run {self._run}; got {run}")


class SameAsJournal(Rule):
    """Each entry is the live journal's, and none of its entries is missing at the end."""

    def __init__(self, extent: Extent, journal: JournalReader, entries: EntriesInOrder) -> None:
        super().__init__(extent)
        self._journal = journal
        self._entries = entries
        self._end_offset = journal.end_offset

    def _hear(self, heard: Heard) -> Iterator[Finding]:
        if not isinstance(heard.message, JournalEntry):
            return
        recorded, subject = heard.message, f"journal entry {heard.message.offset}"
        (live, *_) = self._journal.read(recorded.offset, 1) or (None,)
        if live is None or live.offset != recorded.offset:
            yield Finding(f"{subject}: expected none, as in the journal; got {recorded.name}")
        elif live.name != recorded.name:
            yield Finding(
                f"{subject}: expected {live.name}, as in the journal; got {recorded.name}"
            )
        elif live.payload != recorded.payload:
            digests = (sha256(it.payload).hexdigest()[:16] for it in (live, recorded))
            expected, got = digests
            yield Finding(
                f"{subject}, {live.name}: expected a payload of digest {expected}, as in the "
                f"journal; got {got}"
            )

    def _end(self) -> Iterator[Finding]:
        recorded = self._entries.next_offset or 0
        if self._extent.slice_ is None and recorded < self._end_offset:
            yield Finding(
                f"expected all journal entries before {self._end_offset}, as the journal has; got "
                f"those before {recorded}",
                is_fault=self._extent.is_folder,
            )


def decode_entry(entry: JournalEntry) -> object:
    """The message in a journal entry.

    Raises:
        MessageError: There is none that can be read.
    """
    return decode_any(entry.payload)
