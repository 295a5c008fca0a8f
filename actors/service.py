"""An actor on the bus: asks for tickets, plays them, spools and delivers what happened."""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from actors.acting import collecting_policy
from actors.delivery import Delivery, wait_until
from actors.envs import ClothbusEnv
from actors.policy import Policy
from actors.rollout import (
    ActingPolicy,
    Start,
    Step,
    rollout,
    to_trajectory,
)
from actors.task import make_task_env
from actors.views import Views
from broker_config.bus import Bus
from broker_config.errors import Refused, SpoolFull
from broker_config.failpoints import Failpoint, reach
from broker_config.heart import Heart, Pulse
from broker_config.joining import StopRequested, attach, insist
from broker_config.messages import (
    Instruction,
    Snapshot,
    SnapshotRequest,
    Ticket,
    TicketReply,
    TicketRequest,
)
from broker_config.preset import Preset, preset_from_json
from broker_config.spool import Spool

_log = logging.getLogger(__name__)

R = TypeVar("R")

ASK_TIMEOUT_SECS = 3.0
TICKET_TIMEOUT_SECS = 4.0
"""Longer than the owner's long poll."""

RETRY_SECS = 0.5

FLUSH_AT_STOP_SECS = 5.0
FLUSH_AT_END_SECS = 60.0


class Actor:
    """One process that acts; `run` returns when the run has ended or the actor was drained.

    Attributes:
        state: What it is doing, in a word, as its heartbeats say.
    """

    def __init__(
        self,
        bus: Bus,
        name: str,
        spool: Spool,
        incarnation: str,
        preset: Preset | None = None,
        *,
        spool_steps: bool = False,
        wrap_env: Callable[[ClothbusEnv], Any] = lambda env: env,
    ) -> None:
        """Prepares an actor.

        Args:
            bus: Its place on the bus, under the same name.
            name: The actor's.
            spool: Where trajectories wait for their ack.
            incarnation: Of this process; another for every start.
            preset: The preset that the run must have, or None to take the run's.
            spool_steps: Make each step durable before the next, as a robot must.
            wrap_env: Gets the environment and returns the one to use.
        """
        self._bus = bus
        self._name = name
        self._spool = spool
        self._preset = preset
        self._spool_steps = spool_steps
        self._wrap_env = wrap_env
        self._keys = bus.keys
        self._incarnation = incarnation
        self._views = Views(bus, name, incarnation)
        self._stop = threading.Event()
        self._pulse = Pulse()
        self._owner_epoch = 0
        self.state = "attaching"
        self._policy: tuple[int, ActingPolicy] | None = None
        self._version = -1

    def stop(self) -> None:
        """Asks the actor to leave at the next step; safe in a signal handler."""
        self._stop.set()

    def run(self) -> bool:
        """Acts until the owner says that it is over, or `stop`.

        Returns:
            Whether the owner said so and has what it shall have; False after `stop`.

        Raises:
            AttachRefused: The owner's versions or preset differ.
            StorageError: The spool cannot be written.
        """
        try:
            preset = self._attach()
        except StopRequested:
            return False
        if recovered := self._spool.recover():
            _log.info("Recovered the %d finished steps of %s", recovered.steps, recovered.id)
            reach(Failpoint.SPOOL_RECOVERED)
        env = self._wrap_env(make_task_env(preset.task))
        heart = Heart(
            self._bus,
            "actor",
            self._name,
            self._incarnation,
            lambda: (self.state, self._numbers()),
            self._pulse,
        )
        key = self._keys.trajectory(self._name)
        try:
            with (
                heart,
                Delivery(self._bus, self._spool, key, lambda: self._owner_epoch) as delivery,
            ):
                delivery.flush(self._beating(lambda: not self._stop.is_set()))
                try:
                    return self._act(env, preset, delivery)
                except StopRequested:
                    self._flush_for(FLUSH_AT_STOP_SECS, delivery)
                    return False
        finally:
            env.close()

    def _act(self, env: ClothbusEnv, preset: Preset, delivery: Delivery) -> bool:
        policies = self._bus.latest_reader(self._keys.policy, Snapshot)
        unplayable: Ticket | None = None
        while True:
            delivery.notify()
            self.state = "waiting"
            reply = self._next_ticket(unplayable)
            unplayable = None
            if reply.owner_epoch != self._owner_epoch:
                self._attach()
                self._policy = None
            if reply.instruction in (Instruction.STOP, Instruction.DRAIN):
                return self._leave(delivery, reply.instruction)
            if reply.ticket is not None:
                reach(Failpoint.TICKET_RECEIVED)
                try:
                    policy = self._exact_policy(preset, reply.ticket, policies.get())
                except Refused as error:
                    _log.warning("Ticket %d given back: %s", reply.ticket.index, error)
                    unplayable = reply.ticket
                    continue
                self.state = "collecting"
                self._play(env, policy, reply.ticket)

    def _leave(self, delivery: Delivery, instruction: Instruction) -> bool:
        """Delivers; returns whether there is no reason to come back."""
        self.state = "leaving"
        if self._flush_for(FLUSH_AT_END_SECS, delivery):
            _log.info("Leaving: %s", instruction.value)
            return True
        waiting = self._spool.status().trajectories
        _log.warning("Leaving with %d trajectories in the spool, for the next start", waiting)
        return instruction is Instruction.STOP

    def _flush_for(self, timeout_secs: float, delivery: Delivery) -> bool:
        return delivery.flush(self._beating(wait_until(time.monotonic() + timeout_secs)))

    def _beating(self, keep_waiting: Callable[[], bool]) -> Callable[[], bool]:
        """Waiting for the owner is no standstill."""

        def beat_and_ask() -> bool:
            self._pulse.beat()
            return keep_waiting()

        return beat_and_ask

    # Joining ----------------------------------------------------------------------------------

    def _attach(self) -> Preset:
        welcome = self._insist(
            lambda: attach(
                self._bus, "actor", self._name, self._incarnation, self._preset, self._stop.wait
            )
        )
        self._owner_epoch = welcome.owner_epoch
        self._preset = preset_from_json(welcome.preset_json)
        return self._preset

    def _next_ticket(self, unplayable: Ticket | None) -> TicketReply:
        # One nonce for one question, however often it has to be asked: an answer that came too
        # late is then not a lost ticket.
        gives_back = (unplayable.index, unplayable.attempt) if unplayable else None
        request = TicketRequest(self._name, self._incarnation, secrets.token_hex(8), gives_back)
        key = self._keys.ticket(self._name)
        return self._insist(
            lambda: self._bus.ask(key, request, TicketReply, timeout_secs=TICKET_TIMEOUT_SECS)
        )

    def _insist(self, ask: Callable[[], R]) -> R:
        return insist(ask, self._stop, self._pulse.beat, self._note_silence)

    def _note_silence(self) -> None:
        self.state = "waiting for the owner"

    # Acting -----------------------------------------------------------------------------------

    def _exact_policy(
        self, preset: Preset, ticket: Ticket, newest: Snapshot | None
    ) -> ActingPolicy:
        """The policy of the ticket's version, and no other.

        Raises:
            Refused: The owner no longer has it.
        """
        version = ticket.policy_version
        if self._policy is None or self._policy[0] != version:
            snapshot = newest
            if snapshot is None or snapshot.version != version:
                self.state = "fetching the policy"
                request = SnapshotRequest(version)
                key = self._keys.policy_version(version)
                snapshot = self._insist(
                    lambda: self._bus.ask(key, request, Snapshot, timeout_secs=ASK_TIMEOUT_SECS)
                )
            policy = Policy.from_bytes(snapshot.network, snapshot.weights)
            self._policy = version, collecting_policy(preset.algorithm, policy)
            self._version = version
        return self._policy[1]

    def _play(self, env: ClothbusEnv, policy: ActingPolicy, ticket: Ticket) -> None:
        id_ = self._spool.next_id()
        events = rollout(env, policy, ticket)
        start = next(events)
        assert isinstance(start, Start)
        if self._spool_steps:
            self._when_there_is_room(lambda: self._spool.begin(id_, ticket, start.observation))
        self._views.show_start(ticket, start.observation)
        steps: list[Step] = []
        for step in events:
            assert isinstance(step, Step)
            steps.append(step)
            self._pulse.beat()
            if self._spool_steps:
                self._spool.append_step(
                    step.action,
                    step.reward,
                    step.observation,
                    terminated=step.terminated,
                    success=step.success,
                    guard=step.guard,
                )
            # Only now: what was done is recorded before anything else happens.
            is_over = step.terminated or step.truncated or len(steps) == ticket.steps
            self._views.show_step(ticket, len(steps), step, is_last=is_over)
            if self._stop.is_set() and not is_over:
                raise StopRequested
        reach(Failpoint.EPISODE_PLAYED)
        if self._spool_steps:
            self._spool.finish()
        else:
            trajectory = to_trajectory(id_, ticket, start, steps)
            self._when_there_is_room(lambda: self._spool.put(trajectory))
        reach(Failpoint.EPISODE_SPOOLED)

    def _when_there_is_room(self, add: Callable[[], None]) -> None:
        """Adds to the spool; while it is full, waits for the owner to take something from it.

        It is tried at least once: what is finished when the actor is stopped shall not be lost.
        """
        while True:
            self._pulse.beat()
            try:
                return add()
            except SpoolFull as error:
                if self.state != "spool full":
                    _log.warning("Waiting: %s", error)
                self.state = "spool full"
                if self._stop.wait(RETRY_SECS):
                    raise StopRequested from error

    def _numbers(self) -> Mapping[str, float]:
        return {"policy_version": self._version, "spooled": self._spool.status().trajectories}
