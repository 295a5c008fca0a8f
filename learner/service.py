"""The learner on the bus: serves tickets, trajectories, policies and the journal as it learns."""

from __future__ import annotations

import logging
import time
from concurrent.futures import Future
from contextlib import ExitStack

from broker_config.bus import Bus, Publisher
from broker_config.errors import AlreadyOwned, BusError, MessageError
from broker_config.failpoints import Failpoint, reach
from broker_config.heart import HUNG_SECS, Heart, Pulse
from broker_config.journal import Journal
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import (
    Ack,
    Attach,
    Control,
    Heartbeat,
    JournalRequest,
    Metrics,
    Refusal,
    Rewards,
    RewardsAck,
    Role,
    Snapshot,
    SnapshotRequest,
    TicketRequest,
    Trajectory,
    Verdict,
    Welcome,
    weights_digest,
)
from broker_config.queries import Responder
from learner.learning import LearningEvent, LearningLoop, PolicyReady, RewardsAwaited
from learner.metrics import LearningMetrics
from learner.owner import Owner
from learner.roll_call import RollCall
from learner.snapshots import SnapshotStore
from learner.ticket_desk import TicketDesk

_log = logging.getLogger(__name__)

FAREWELL_SECS = 10.0
"""How long a finished learner stays to tell its actors that the run is over."""

FOLLOWER_SECS = 15.0
"""How long a finished learner waits for a word of a follower that lacks something."""

TOKEN_SECS = 3.0
"""A killed process's token is gone by then."""

POLL_SECS = 0.1
MAX_BATCH_BYTES = 32 << 20


class LearnerService:
    """One learner process: `run` returns when the run is complete or was stopped."""

    def __init__(
        self,
        bus: Bus,
        bulk_bus: Bus,
        name: str,
        owner: Owner,
        loop: LearningLoop,
        journal: Journal,
        snapshots: SnapshotStore,
        metrics: LearningMetrics,
        pulse: Pulse,
        hung_secs: float = HUNG_SECS,
    ) -> None:
        """Joins the parts.

        Args:
            bus: Its place on the bus.
            bulk_bus: The same place by a connection of its own, for large answers. Whoever asks for
                them and does not read them holds up this connection, and not tickets and acks.
            name: Under which it is there.
            owner: Of the run.
            loop: What it does.
            journal: The owner's.
            snapshots: The loop's.
            metrics: Where the numbers go.
            pulse: Beaten by the loop's trainer too, so that a long update is no stall.
            hung_secs: An actor whose main thread gets nowhere for so long loses its tickets.
        """
        self._bus = bus
        self._bulk_bus = bulk_bus
        self._name = name
        self._owner = owner
        self._loop = loop
        self._journal = journal
        self._snapshots = snapshots
        self._metrics = metrics
        self._pulse = pulse
        self._hung_secs = hung_secs
        self._keys = bus.keys
        self._state = "starting"
        self._awaited: RewardsAwaited | None = None
        """What keeps the loop waiting for discriminators."""
        self._roll_call = RollCall()

    def run(self) -> None:
        """Learns until the end of the run; everything on the bus closes with it."""
        self._refuse_second_owner()
        with ExitStack() as stack:
            desk = stack.enter_context(TicketDesk(self._owner))
            self._serve(desk)
            incarnation = f"epoch-{self._owner.epoch}"
            self._pulse.beat()  # what came before is the start, and no standstill
            stack.enter_context(
                Heart(
                    self._bus,
                    "owner",
                    self._name,
                    incarnation,
                    lambda: (self._described_state(), self._numbers()),
                    self._pulse,
                )
            )
            policies = self._bus.latest_publisher(self._keys.policy)
            metrics = self._bus.publisher(self._keys.metrics("owner", self._name))
            self._learn(policies, metrics, incarnation)
            self._state, self._awaited = "finished", None
            self._wait_for_farewells("actor")
            end_offset = self._owner.close_record()
            self._wait_for_farewells("discriminator")
            self._wait_for_followers(end_offset)

    def _learn(self, policies: Publisher, metrics: Publisher, incarnation: str) -> None:
        self._state = "waiting for actors"
        for sequence, event in enumerate(self._loop):
            self._pulse.beat()
            self._note(event)
            if isinstance(event, PolicyReady):
                policies.put(event.snapshot)
                reach(Failpoint.SNAPSHOT_PUBLISHED)
            self._metrics.note(event)
            step, numbers = self._metrics.step, self._numbers()
            metrics.put(Metrics("owner", self._name, incarnation, sequence, step, numbers))

    def _note(self, event: LearningEvent) -> None:
        if not isinstance(event, PolicyReady):
            self._state = "learning"
        self._awaited = event if isinstance(event, RewardsAwaited) else None
        if self._awaited is not None:
            _log.info("%s", self._described_state())

    def _described_state(self) -> str:
        """What keeps the run, for a person; any thread."""
        if (awaited := self._awaited) is None:
            return self._state
        state = f"waiting for rewards of iteration {awaited.iteration}"
        if self._roll_call.has_living("discriminator", time.monotonic()):
            return state
        run = self._bus.keys.run
        return f"{state}: nobody gives any, start `clothbus discriminator --run {run}`"

    def _numbers(self) -> dict[str, float]:
        attempts = self._owner.attempts
        wrong = {"invalid": attempts[Verdict.INVALID], "lost": attempts[Verdict.LOST]}
        state = {"paused": float(self._owner.is_paused)}
        return self._metrics.numbers | wrong | state

    def _wait_for_farewells(self, role: Role) -> None:
        """Stays until every process of a role has heard that it may leave."""
        deadline_secs = time.monotonic() + FAREWELL_SECS
        try:
            while time.monotonic() < deadline_secs and self._alive(role):
                self._pulse.beat()
                time.sleep(POLL_SECS)
        except BusError as error:
            _log.warning("Leaving without a farewell: %s", error)

    def _wait_for_followers(self, end_offset: int) -> None:
        """Stays until whoever records has everything, or says nothing any more."""
        followers = self._owner.followers
        followers.expect(time.monotonic())
        while behind := followers.behind(end_offset, time.monotonic() - FOLLOWER_SECS):
            self._state = f"finished, waits for {', '.join(behind)}"
            self._pulse.beat()
            time.sleep(POLL_SECS)

    def _refuse_second_owner(self) -> None:
        """Two owners of one run name would each get a part of what actors send.

        Raises:
            AlreadyOwned: Another process owns a run of this name on this router.
        """
        deadline_secs = time.monotonic() + TOKEN_SECS
        while self._alive("owner"):
            if time.monotonic() > deadline_secs:
                raise AlreadyOwned(
                    f"run {self._bus.keys.run}: expected no other owner on the router; got one; "
                    "stop it, or give one of the run folders another name"
                )
            time.sleep(POLL_SECS)

    def _alive(self, role: Role) -> bool:
        return any(key.role == role for key in self._bus.alive())

    # What others ask --------------------------------------------------------------------------

    def _serve(self, desk: TicketDesk) -> None:
        keys, bus = self._keys, self._bus
        bus.subscribe(keys.every(Kind.LIVE), Heartbeat, self._on_heartbeat)
        bus.serve(keys.every(Kind.ATTACH), Attach, self._on_attach)
        bus.serve(keys.every(Kind.TRAJECTORY), Trajectory, self._on_trajectory)
        bulk = self._bulk_bus
        bulk.serve(keys.every(Kind.POLICY_VERSION), SnapshotRequest, self._on_snapshot_request)
        bulk.serve(keys.every(Kind.JOURNAL), JournalRequest, self._on_journal_request)
        bus.serve(keys.control, Control, self._on_control)
        bus.serve(keys.every(Kind.REWARDS), Rewards, self._on_rewards)

        bus.serve(
            keys.every(Kind.TICKET),
            TicketRequest,
            lambda _, request, to: desk.ask(request, to.reply),
        )

    def _on_heartbeat(self, _: ParsedKey, heartbeat: Heartbeat) -> None:
        now_secs = time.monotonic()
        self._roll_call.heard(heartbeat, now_secs)
        hangs = heartbeat.stalled_secs > self._hung_secs  # its tickets go to others
        if heartbeat.role == "actor" and not hangs:
            self._owner.heard(heartbeat.id, heartbeat.incarnation, now_secs)

    def _on_attach(self, _: ParsedKey, request: Attach, to: Responder) -> None:
        now_secs = time.monotonic()
        answer = self._roll_call.refusal(request, now_secs) or self._owner.attach(request)
        if isinstance(answer, Welcome):
            self._roll_call.joined(request, now_secs)
        to.reply(answer)

    def _on_trajectory(self, _: ParsedKey, trajectory: Trajectory, to: Responder) -> None:
        def answer(ack: Future[Ack]) -> None:
            error = ack.exception()
            if isinstance(error, Exception):
                to.fail(error)
            else:
                reach(Failpoint.TRAJECTORY_JOURNALED)
                to.reply(ack.result())

        reach(Failpoint.TRAJECTORY_RECEIVED)
        # Kept as it was sent: encoding it again would cost as much as all the rest.
        self._owner.receive(trajectory, to.question).add_done_callback(answer)

    def _on_snapshot_request(self, _: ParsedKey, request: SnapshotRequest, to: Responder) -> None:
        weights = self._snapshots.get(request.version)
        if weights is None:
            retained = ", ".join(map(str, self._snapshots.versions()))
            to.reply(
                Refusal(
                    "policy version",
                    f"one of {retained}",
                    str(request.version),
                    "ask for a new ticket: it names a version that exists",
                )
            )
            return
        spec, epoch = self._owner.preset.network, self._owner.epoch
        to.reply(Snapshot(request.version, epoch, spec, weights, weights_digest(weights)))

    def _on_journal_request(self, _: ParsedKey, request: JournalRequest, to: Responder) -> None:
        to.reply(self._owner.follow(request, MAX_BATCH_BYTES, time.monotonic()))

    def _on_control(self, _: ParsedKey, control: Control, to: Responder) -> None:
        to.reply(self._owner.control(control, self._roll_call.names("actor")))

    def _on_rewards(self, _: ParsedKey, rewards: Rewards, to: Responder) -> None:
        def answer(ack: Future[RewardsAck]) -> None:
            error = ack.exception()
            if isinstance(error, MessageError):
                to.refuse(error)
            elif isinstance(error, Exception):
                to.fail(error)
            else:
                reach(Failpoint.REWARDS_JOURNALED)
                to.reply(ack.result())

        reach(Failpoint.REWARDS_RECEIVED)
        self._owner.receive_rewards(rewards, to.question).add_done_callback(answer)
