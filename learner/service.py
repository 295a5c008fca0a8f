"""The learner on the bus: serves tickets, trajectories, policies and the journal as it learns."""

from __future__ import annotations

import logging
import threading
import time
from contextlib import ExitStack

from broker_config.bus import Bus, Publisher
from broker_config.codec import encode
from broker_config.heart import Heart
from broker_config.journal import Journal
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import (
    Attach,
    Control,
    Heartbeat,
    JournalBatch,
    JournalRequest,
    Metrics,
    Refusal,
    Snapshot,
    SnapshotRequest,
    TicketRequest,
    Trajectory,
    weights_digest,
)
from broker_config.queries import Responder
from learner.learning import LearningLoop, PolicyReady
from learner.metrics import LearningMetrics
from learner.owner import Owner
from learner.snapshots import SnapshotStore
from learner.ticket_desk import TicketDesk

_log = logging.getLogger(__name__)

FAREWELL_SECS = 10.0
"""How long a finished learner stays to tell its actors that the run is over."""

MAX_BATCH_BYTES = 32 << 20


class LearnerService:
    """One learner process: `run` returns when the run is complete or was stopped."""

    def __init__(
        self,
        bus: Bus,
        name: str,
        owner: Owner,
        loop: LearningLoop,
        journal: Journal,
        snapshots: SnapshotStore,
        metrics: LearningMetrics,
    ) -> None:
        self._bus = bus
        self._name = name
        self._owner = owner
        self._loop = loop
        self._journal = journal
        self._snapshots = snapshots
        self._metrics = metrics
        self._keys = bus.keys
        self._state = "starting"
        self._actors: dict[str, str] = {}
        self._actors_changed = threading.Condition()

    def run(self) -> None:
        """Learns until the end of the run; everything on the bus closes with it."""
        with ExitStack() as stack:
            desk = stack.enter_context(TicketDesk(self._owner))
            self._serve(desk)
            incarnation = f"epoch-{self._owner.epoch}"
            stack.enter_context(
                Heart(
                    self._bus,
                    "owner",
                    self._name,
                    incarnation,
                    lambda: (self._state, dict(self._metrics.numbers)),
                )
            )
            policies = self._bus.latest_publisher(self._keys.policy)
            metrics = self._bus.publisher(self._keys.metrics("owner", self._name))
            self._learn(policies, metrics)
            self._state = "finished"
            self._wait_for_farewells()

    def _learn(self, policies: Publisher, metrics: Publisher) -> None:
        self._state = "waiting for actors"
        for event in self._loop:
            if isinstance(event, PolicyReady):
                policies.put(event.snapshot)
            else:
                self._state = "learning"
            numbers = self._metrics.note(event)
            metrics.put(Metrics("owner", self._name, self._metrics.step, numbers))

    def _wait_for_farewells(self) -> None:
        """Stays until every actor has heard that it may leave."""
        deadline_secs = time.monotonic() + FAREWELL_SECS
        while time.monotonic() < deadline_secs and any(
            key.role == "actor" for key in self._bus.alive()
        ):
            with self._actors_changed:
                self._actors_changed.wait(0.1)

    # What others ask --------------------------------------------------------------------------

    def _serve(self, desk: TicketDesk) -> None:
        keys, bus = self._keys, self._bus
        bus.watch_alive(self._on_alive)
        bus.subscribe(keys.every(Kind.LIVE), Heartbeat, self._on_heartbeat)
        bus.serve(keys.every(Kind.ATTACH), Attach, self._on_attach)
        bus.serve(keys.every(Kind.TRAJECTORY), Trajectory, self._on_trajectory)
        bus.serve(keys.every(Kind.POLICY_VERSION), SnapshotRequest, self._on_snapshot_request)
        bus.serve(keys.journal, JournalRequest, self._on_journal_request)
        bus.serve(keys.control, Control, self._on_control)

        bus.serve(
            keys.every(Kind.TICKET),
            TicketRequest,
            lambda _, request, to: desk.ask(request, to.reply),
        )

    def _on_alive(self, key: ParsedKey, is_alive: bool) -> None:
        with self._actors_changed:
            if key.role == "actor" and not is_alive:
                self._actors.pop(str(key.id), None)
            self._actors_changed.notify_all()

    def _on_heartbeat(self, _: ParsedKey, heartbeat: Heartbeat) -> None:
        if heartbeat.role == "actor":
            with self._actors_changed:
                self._actors[heartbeat.id] = heartbeat.incarnation
            self._owner.heard(heartbeat.id, heartbeat.incarnation, time.monotonic())

    def _on_attach(self, _: ParsedKey, request: Attach, to: Responder) -> None:
        with self._actors_changed:
            living = self._actors.get(request.id, request.incarnation)
        if request.role == "actor" and living != request.incarnation:
            to.reply(
                Refusal(
                    "actor name",
                    "a name that no living actor has",
                    f"{request.id}, which acts as incarnation {living}",
                    "choose another --id, or end the other process first",
                )
            )
            return
        to.reply(self._owner.attach(request))

    def _on_trajectory(self, _: ParsedKey, trajectory: Trajectory, to: Responder) -> None:
        self._owner.receive(trajectory, encode(trajectory), to.reply)

    def _on_snapshot_request(self, _: ParsedKey, request: SnapshotRequest, to: Responder) -> None:
        weights = self._snapshots.get(request.version)
        if weights is None or request.version > self._owner.latest_version:
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
        size = min(request.max_bytes, MAX_BATCH_BYTES)
        entries = self._journal.read(request.offset, size)
        to.reply(JournalBatch(self._owner.epoch, entries, self._journal.end_offset))

    def _on_control(self, _: ParsedKey, control: Control, to: Responder) -> None:
        with self._actors_changed:
            actors = list(self._actors)
        to.reply(self._owner.control(control, actors))
