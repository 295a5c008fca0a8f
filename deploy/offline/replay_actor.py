"""Answers a live learner's tickets with recorded episodes: `clothbus replay --as actors`.

Its recording is its spool: what is not acked is sent again, and a process that starts anew reads
the episodes once more.
"""

from __future__ import annotations

import logging
import secrets
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

from broker_config.bus import Bus
from broker_config.errors import MessageError, Refused
from broker_config.heart import Heart, Pulse
from broker_config.joining import StopRequested, attach, insist
from broker_config.latest import LatestReader
from broker_config.messages import (
    Ack,
    Instruction,
    Snapshot,
    SnapshotRequest,
    Ticket,
    TicketReply,
    TicketRequest,
    Trajectory,
    TrajectoryId,
    Verdict,
)
from broker_config.preset import Preset, preset_from_json
from deploy.offline.recorded_episodes import RecordedEpisodes, require_same_task

_log = logging.getLogger(__name__)

ASK_TIMEOUT_SECS = 5.0

_Reply = TypeVar("_Reply")


@dataclass
class Delivered:
    """What became of the recorded episodes."""

    accepted: int = 0
    refused: int = 0
    """Trajectories that the learner did not take: spare ones, and those that it has no use for."""
    on_other_policies: int = 0
    """Accepted ones that were recorded on another policy than the learner has for their ticket."""


class ReplayActor:
    """One process that delivers what was recorded; `run` returns when there is nothing to deliver.

    Attributes:
        delivered: What became of the episodes so far.
        state: What it is doing, as its heartbeats say.
    """

    def __init__(self, bus: Bus, name: str, episodes: RecordedEpisodes) -> None:
        """Prepares an actor.

        Args:
            bus: Its place on the bus, under the same name.
            name: The actor's.
            episodes: Ticket k is answered with the k-th.
        """
        self._bus = bus
        self._name = name
        self._episodes = episodes
        self._incarnation = secrets.token_hex(8)
        self._stop = threading.Event()
        self._pulse = Pulse()
        self._owner_epoch = -1
        self._sequence = 0
        self._digest: tuple[int, str] | None = None
        """Of the learner's policy of a version."""
        self.delivered = Delivered()
        self.state = "attaching"

    def stop(self) -> None:
        """Asks the actor to leave; safe in a signal handler."""
        self._stop.set()

    def run(self) -> bool:
        """Delivers until the owner says that it is over, or all that was recorded is delivered.

        Returns:
            Whether there is nothing more to do; False after `stop`.

        Raises:
            AttachRefused: The owner's versions differ, or the name is taken.
            MessageError: The learner has no use for a recorded episode.
            PresetError: The run is of another task than what was recorded.
        """
        try:
            preset = self._attach(None)
            recorded = self._episodes.runs[0].preset.task
            require_same_task(preset.task, recorded, preset.name)
            with self._heart():
                self._deliver(preset)
        except StopRequested:
            return False
        return True

    def _heart(self) -> Heart:
        return Heart(
            self._bus,
            "actor",
            self._name,
            self._incarnation,
            lambda: (self.state, self._numbers()),
            self._pulse,
        )

    def _numbers(self) -> Mapping[str, float]:
        it = self.delivered
        return {"delivered": it.accepted, "on_other_policies": it.on_other_policies}

    def _deliver(self, preset: Preset) -> None:
        policies = self._bus.latest_reader(self._bus.keys.policy, Snapshot)
        while True:
            self.state = "waiting"
            reply = self._next_ticket()
            if reply.owner_epoch != self._owner_epoch:
                self._attach(preset)
            if reply.instruction in (Instruction.STOP, Instruction.DRAIN):
                return
            if reply.ticket is None:
                continue
            if reply.ticket.index >= len(self._episodes):
                _log.info("Leaving: all %d recorded episodes are delivered", len(self._episodes))
                return
            self.state = f"delivering episode {reply.ticket.index}"
            self._answer(reply.ticket, policies)

    def _answer(self, ticket: Ticket, policies: LatestReader[Snapshot]) -> None:
        recorded = self._episodes.answer(ticket)
        id_ = TrajectoryId(self._name, self._incarnation, self._sequence)
        self._sequence += 1
        ack = self._send(replace(recorded, id=id_, ticket=ticket))
        if ack.verdict is Verdict.INVALID:
            raise MessageError(  # the same once more would be no better
                f"episode {ticket.index}: expected the learner to take what was recorded; got "
                f"{ack.verdict.value}; see the learner's log for the reason"
            )
        if ack.verdict is not Verdict.ACCEPTED:
            self.delivered.refused += 1
            return
        self.delivered.accepted += 1
        played_on = self._episodes.policy_digest(ticket.index, recorded.ticket.policy_version)
        if played_on != self._digest_of(ticket.policy_version, policies.get()):
            self.delivered.on_other_policies += 1

    def _digest_of(self, version: int, newest: Snapshot | None) -> str | None:
        """Of the learner's policy of a version; None if it no longer has it."""
        if self._digest is None or self._digest[0] != version:
            if newest is None or newest.version != version:
                key = self._bus.keys.policy_version(version)
                try:
                    newest = self._insist_on(key, SnapshotRequest(version), Snapshot)
                except Refused:
                    return None
            self._digest = version, newest.digest
        return self._digest[1]

    # The owner --------------------------------------------------------------------------------

    def _send(self, trajectory: Trajectory) -> Ack:
        key = self._bus.keys.trajectory(self._name)
        return self._insist_on(key, trajectory, Ack)

    def _next_ticket(self) -> TicketReply:
        request = TicketRequest(self._name, self._incarnation, secrets.token_hex(8))
        return self._insist_on(self._bus.keys.ticket(self._name), request, TicketReply)

    def _insist_on(self, key: str, request: object, reply: type[_Reply]) -> _Reply:
        return self._insist(
            lambda: self._bus.ask(key, request, reply, timeout_secs=ASK_TIMEOUT_SECS)
        )

    def _attach(self, preset: Preset | None) -> Preset:
        welcome = self._insist(
            lambda: attach(
                self._bus, "actor", self._name, self._incarnation, preset, self._stop.wait
            )
        )
        self._owner_epoch = welcome.owner_epoch
        return preset_from_json(welcome.preset_json)

    def _insist(self, ask: Callable[[], _Reply]) -> _Reply:
        return insist(ask, self._stop, self._pulse.beat, self._note_silence)

    def _note_silence(self) -> None:
        self.state = "waiting for the owner"
