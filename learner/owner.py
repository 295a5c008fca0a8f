"""The durable owner of a run: everything that counts is in its journal before anyone is told.

`learner.run_journal` names the entries.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Future

from broker_config.codec import decode, decode_any
from broker_config.errors import StorageError
from broker_config.joining import refusal
from broker_config.journal import Journal
from broker_config.messages import (
    Ack,
    Attach,
    AttemptEnded,
    Command,
    Control,
    ControlReply,
    FollowerJoined,
    Instruction,
    IterationAnnounced,
    IterationEnded,
    JournalBatch,
    JournalRequest,
    Refusal,
    Rewards,
    RewardsAck,
    RunStarted,
    SnapshotTaken,
    Ticket,
    TicketIssued,
    TicketReply,
    TicketRequest,
    TicketReseeded,
    Trajectory,
    TrajectoryId,
    Verdict,
    Welcome,
)
from broker_config.preset import Preset
from broker_config.version import VERSION
from learner.arrivals import Arrivals, Received
from learner.followers import Followers
from learner.given_demonstrations import GivenDemonstrations
from learner.recorded import trajectory_name
from learner.reward_desk import RewardDesk
from learner.run_journal import Committed, RunJournal, nothing_to_commit
from learner.steering import Steering, spelled_out
from learner.tickets import TicketBook, TicketEvent

_LARGE = ("trajectory/", "demonstration/", "announced/", "rewards/")
"""Names of entries that are large, and of no use for the tickets."""


class Owner:
    """Issues tickets, takes trajectories and keeps the journal of one run.

    Thread-safe: the bus's threads and the learning thread share it. `changed` is notified, and
    `changes` grows, whenever a waiting ticket request or the learning loop may go on; `attempts`
    counts those of this epoch that went wrong; `given` are the run's demonstrations; `reward_desk`
    is where discriminators deliver.
    """

    def __init__(self, run: str, preset: Preset, journal: Journal) -> None:
        """Takes the run: replays its journal and notes the new epoch.

        Raises:
            StorageError: The journal belongs to another preset, or cannot be written.
        """
        self.run = run
        self.preset = preset
        self._journal = journal
        self._record = RunJournal(journal)
        self.changed, self.attempts = self._record.changed, self._record.attempts
        self._book = TicketBook(preset, self._issued_before)
        self._arrivals = Arrivals(journal)
        self._received = Received()
        self._latest_version = -1
        self._steering = Steering()
        self._controls = 0
        self._joins = 0
        self._is_over = False
        self.followers = Followers()
        self.epoch = self._replay() + 1
        self.given = GivenDemonstrations(run, preset.network, journal, self._record.append)
        self.reward_desk = RewardDesk(
            journal,
            lambda name, item: self._record.append((name, item)),
            self.epoch,
            self._record.note_change,
        )
        started = RunStarted(run, self.epoch, preset.to_json(), VERSION)
        self._record.append((f"run/{self.epoch}", started)).result()

    @property
    def changes(self) -> int:
        """How often `changed` was notified."""
        return self._record.changes

    def note_change(self) -> None:
        """Wakes whoever waits for something to happen."""
        self._record.note_change()

    # Joining ----------------------------------------------------------------------------------

    def attach(self, request: Attach) -> Welcome | Refusal:
        """Lets a process join if it speaks the same contract about the same preset."""
        if (no := refusal(request, self.preset)) is not None:
            return no
        return Welcome(self.run, self.epoch, self.preset.to_json())

    # Tickets ----------------------------------------------------------------------------------

    def issue(
        self, request: TicketRequest, now_secs: float
    ) -> tuple[TicketReply, Committed] | None:
        """Answers a ticket request, or None while there is nothing to collect.

        The answer may be sent once the future has resolved: then it is in the journal.

        Raises:
            StorageError: The run cannot go on.
        """
        with self.changed:
            self._record.require_sound()
            if (farewell := self._farewell(request.actor)) is not None:
                return self._reply(request, farewell), nothing_to_commit()
            if (repeated := self._book.repeated(request)) is not None:
                self._book.heard(request.actor, request.incarnation, now_secs)
                return self._reply(request, Instruction.COLLECT, repeated), nothing_to_commit()
            if self._steering.is_paused:
                return None
            ticket, events = self._book.issue(request, self._latest_version, now_secs)
            future = self._record.append_events(events)
            if ticket is None:
                return None
            return self._reply(request, Instruction.COLLECT, ticket), future

    def _farewell(self, actor: str) -> Instruction | None:
        return Instruction.STOP if self._book.all_complete else self._steering.farewell(actor)

    def _reply(
        self, request: TicketRequest, instruction: Instruction, ticket: Ticket | None = None
    ) -> TicketReply:
        return TicketReply(instruction, request.nonce, self.epoch, ticket)

    def wait_reply(self, request: TicketRequest) -> TicketReply:
        """What a request gets when its long poll ends without a ticket."""
        return self._reply(request, Instruction.WAIT)

    def has_news_for(self, actor: str) -> bool:
        """Whether a request of an actor that was not answered before would be now."""
        with self.changed:
            if self._record.has_failed or self._farewell(actor) is not None:
                return True
            return not self._steering.is_paused and self._book.may_issue(self._latest_version)

    def heard(self, actor: str, incarnation: str, now_secs: float) -> None:
        """Renews an actor's leases."""
        with self.changed:
            self._book.heard(actor, incarnation, now_secs)

    def expire_leases(self, now_secs: float) -> None:
        """Gives up what silent actors were collecting, so that others collect it again."""
        with self.changed:
            self._record.require_sound()
            if events := self._book.expire(now_secs):
                self._record.append_events(events)
                self.note_change()

    # Trajectories -----------------------------------------------------------------------------

    def receive(self, trajectory: Trajectory, payload: bytes) -> Future[Ack]:
        """Takes a trajectory; the ack is there once it is durable.

        A resend is recognised by its id and acknowledged again, and changes nothing. If the journal
        fails, so does the future, and the sender keeps what it has.

        Raises:
            MessageError: The preset's network cannot learn from it.
            StorageError: The run cannot go on.
        """
        trajectory.check_fits(self.preset.network)
        self._journal.wait_for_room()
        with self.changed:
            self._record.require_sound()
            self._require_going_on()
            known = self._arrivals.verdict(trajectory.id)
            events = [] if known else self._book.close(trajectory)
            verdict = known or _verdict_in(events)
            if not known:
                self._arrivals.arrived(trajectory.id, verdict)
            if verdict is Verdict.ACCEPTED and not known:
                self._received.put(trajectory)
            appended = self._record.append_events(events, (trajectory_name(trajectory.id), payload))
        ack: Future[Ack] = Future()

        def acknowledge(done: Committed) -> None:
            if (error := done.exception()) is not None:
                ack.set_exception(error)
                return
            stored = done.result()[0]
            with self.changed:
                self._arrivals.committed(trajectory.id)
                self.note_change()
            is_duplicate = not stored.is_new
            ack.set_result(Ack(trajectory.id, self.epoch, stored.offset, verdict, is_duplicate))

        appended.add_done_callback(acknowledge)
        return ack

    def _issued_before(self, index: int, attempt: int) -> TicketIssued | None:
        entry = self._journal.find(f"ticket/{index}/{attempt}")
        return None if entry is None else decode(entry.payload, TicketIssued)

    # What the learning loop asks --------------------------------------------------------------

    @property
    def latest_version(self) -> int:
        """Newest policy version that tickets may name; -1 before there is one."""
        return self._latest_version

    @property
    def all_complete(self) -> bool:
        """Whether every episode of the run is in the journal."""
        with self.changed:
            return self._book.all_complete

    @property
    def is_paused(self) -> bool:
        """Whether tickets are held back until a `resume`."""
        return self._steering.is_paused

    @property
    def is_stopping(self) -> bool:
        """Whether the run was asked to stop before its end."""
        return self._steering.is_stopping

    def is_ready(self, index: int) -> bool:
        """Whether ticket `index` is complete and durable."""
        with self.changed:
            is_complete = self._book.is_complete(index)
            return is_complete and self._arrivals.are_durable(self._book.parts(index))

    def wait_ready(self, index: int, timeout_secs: float) -> bool:
        """Waits until ticket `index` is complete and durable, or the time or the run is over.

        Raises:
            StorageError: The journal could not be written; the run cannot go on.
        """
        with self.changed:
            self.changed.wait_for(
                lambda: self.is_ready(index) or self.is_stopping or self._record.has_failed,
                timeout_secs,
            )
            self._record.require_sound()
            return self.is_ready(index)

    def trajectories(self, index: int) -> list[Trajectory]:
        """The accepted parts of a complete ticket, as they are in the journal."""
        with self.changed:
            parts = self._book.parts(index)
            received = [self._received.take(part) for part in parts]
        return [
            kept or self._read_trajectory(part) for part, kept in zip(parts, received, strict=True)
        ]

    def _read_trajectory(self, id_: TrajectoryId) -> Trajectory:
        entry = self._journal.find(trajectory_name(id_))
        if entry is None:
            raise StorageError(f"journal: expected trajectory {id_}; it is not there")
        return decode(entry.payload, Trajectory)

    def policy_ready(self, snapshot: SnapshotTaken) -> None:
        """Journals a policy version; from then on tickets may name it."""
        name = f"snapshot/{snapshot.version}/{snapshot.digest[:16]}"
        (appended,) = self._record.append((name, snapshot)).result()
        self.followers.snapshot_taken(snapshot, appended.offset)
        with self.changed:
            self._latest_version = snapshot.version
            self.note_change()

    def iteration_ended(self, iteration: IterationEnded) -> None:
        """Journals the end of an iteration; its tickets need not be asked for again."""
        self._record.append((f"iteration/{iteration.iteration}", iteration)).result()
        per_iteration = self.preset.schedule.episodes_per_iteration
        with self.changed:
            self._book.forget_before((iteration.iteration + 1) * per_iteration)

    # Rewards ----------------------------------------------------------------------------------

    def receive_rewards(self, rewards: Rewards, payload: bytes) -> Future[RewardsAck]:
        """Takes an iteration's rewards; see `RewardDesk.receive`.

        Raises:
            MessageError: They are of an iteration or a D_G that was not announced, or too few.
            StorageError: The run cannot go on, or is over.
        """
        with self.changed:
            self._record.require_sound()
            self._require_going_on()
            return self.reward_desk.receive(rewards, payload)

    def wait_rewards(self, announced: IterationAnnounced, timeout_secs: float) -> Rewards | None:
        """An announced iteration's rewards; None if something else happened, or nothing in time.

        Raises:
            StorageError: The journal could not be written; the run cannot go on.
        """
        with self.changed:
            self._record.require_sound()
            seen = self.changes
        if (given := self.reward_desk.rewards_of(announced)) is None:
            with self.changed:
                self.changed.wait_for(lambda: self.changes != seen, timeout_secs)
        return given

    # Followers --------------------------------------------------------------------------------

    def follow(self, request: JournalRequest, max_bytes: int, now_secs: float) -> JournalBatch:
        """Gives a follower the next entries; a new one becomes part of the run's record.

        Raises:
            StorageError: The journal cannot be read or written.
        """
        keeps_a_copy = request.role != "discriminator"  # which only reads, and needs no policies
        if keeps_a_copy and not self.followers.is_known(request.id):
            self._join(FollowerJoined(request.role, request.id))
        if keeps_a_copy:
            self.followers.heard(request, now_secs)
        # First what is final, then how far it goes: an entry in between shows in the end offset.
        is_over = self._is_over
        end_offset = self._journal.end_offset
        entries = self._journal.read(request.offset, min(request.max_bytes, max_bytes))
        return JournalBatch(self.epoch, entries, end_offset, is_over)

    def _join(self, joined: FollowerJoined) -> None:
        with self.changed:
            self._record.require_sound()
            self._joins += 1
            future = self._record.append(
                (f"follower/{joined.id}/{self.epoch}/{self._joins}", joined)
            )
        future.result()
        self.followers.apply(joined)

    def close_record(self) -> int:
        """Takes nothing more, so that followers can come to an end; returns the end offset.

        What actors still hold stays in their spools, for the next start.
        """
        with self.changed:
            self._is_over = True
        return self._journal.end_offset

    def _require_going_on(self) -> None:
        if self._is_over:
            raise StorageError(
                f"run {self.run}: expected a run that goes on; got one that is over; what was sent "
                "is sent again, or made again, when the run is resumed"
            )

    # Control ----------------------------------------------------------------------------------

    def control(self, control: Control, actors: Iterable[str] = ()) -> ControlReply:
        """Does what a person asked, and journals it.

        Args:
            control: The command.
            actors: Who is there, for a `drain` that names nobody.
        """
        with self.changed:
            self._record.require_sound()
            orders = spelled_out(control, actors)
            first = self._controls + 1
            self._controls += len(orders)
            future = self._record.append(
                *((f"control/{self.epoch}/{n}", order) for n, order in enumerate(orders, first))
            )
            for order in orders:
                self._apply_control(order)
            self.note_change()
            state = self._steering.state
        future.result()
        return ControlReply(control.command, state)

    def stop(self) -> None:
        """Ends the run early: actors are told, `wait_ready` returns."""
        with self.changed:
            self._steering.is_stopping = True
            self.note_change()

    def _apply_control(self, control: Control) -> None:
        self._steering.apply(control)
        if control.command is Command.FORGET:
            self.followers.forget(control.process)

    # The journal ------------------------------------------------------------------------------

    def fail(self, error: BaseException) -> None:
        """Ends the run with an error, from any thread: nothing more is issued or acked."""
        self._record.fail(error)

    def _replay(self) -> int:
        """Rebuilds the book; returns the last epoch."""
        epoch = 0
        for entry in self._journal.entries(without=_LARGE):
            match decode_any(entry.payload):
                case RunStarted() as started:
                    epoch = started.owner_epoch
                    self._refuse_other_preset(started)
                case TicketIssued() | AttemptEnded() | TicketReseeded() as event:
                    self._book.apply(event)
                    if isinstance(event, AttemptEnded) and event.trajectory is not None:
                        self._arrivals.committed(event.trajectory)
                case Control() as control if control.command is not Command.STOP:
                    self._apply_control(control)
                case FollowerJoined() as joined:
                    self.followers.apply(joined)
                case SnapshotTaken() as snapshot:
                    self.followers.snapshot_taken(snapshot, entry.offset)
        return epoch

    def _refuse_other_preset(self, started: RunStarted) -> None:
        if started.preset_json != self.preset.to_json():
            raise StorageError(
                f"journal: expected preset {self.preset.name} ({self.preset.digest[:12]}); "
                "got a run of another preset; resume it with its own, or choose another run folder"
            )


def _verdict_in(events: Sequence[TicketEvent]) -> Verdict:
    return next(event.verdict for event in events if isinstance(event, AttemptEnded))
