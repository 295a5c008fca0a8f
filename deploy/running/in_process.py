"""The same cores in one process without a bus: for experiments and debugging."""

from __future__ import annotations

import secrets
import time
from abc import ABC, abstractmethod

from actors.acting import collecting_policy
from actors.envs import ClothbusEnv
from actors.policy import Policy
from actors.rollout import ActingPolicy, collect
from broker_config.codec import encode
from broker_config.errors import StorageError
from broker_config.journal import JournalReader
from broker_config.messages import (
    IterationAnnounced,
    Rewards,
    Ticket,
    TicketRequest,
    Trajectory,
    TrajectoryId,
)
from discriminator.labelling import Labeller
from learner.owner import Owner
from learner.snapshots import SnapshotStore

ACTOR = "in-process"
IDLE_SECS = 0.1
_BATCH_BYTES = 4 << 20


class AnsweringActor(ABC):
    """Answers the owner's tickets in the calling thread, one for each call."""

    def __init__(self, owner: Owner) -> None:
        """Prepares an actor.

        Args:
            owner: Asked for tickets.
        """
        self._owner = owner
        self._incarnation = secrets.token_hex(8)
        self._sequence = 0

    def play_until_ready(self, index: int) -> bool:
        """Plays one ticket if there is one to play; returns whether ticket `index` is ready."""
        now_secs = time.monotonic()
        self._owner.expire_leases(now_secs)  # what other actors of a resumed run had
        request = TicketRequest(ACTOR, self._incarnation, secrets.token_hex(8))
        issued = self._owner.issue(request, now_secs)
        if issued is None:
            return self._owner.wait_ready(index, IDLE_SECS)
        reply, committed = issued
        committed.result()
        if reply.ticket is not None:
            id_ = TrajectoryId(ACTOR, self._incarnation, self._sequence)
            self._sequence += 1
            trajectory = self.answer(id_, reply.ticket)
            self._owner.receive(trajectory, encode(trajectory)).result()
        return self._owner.is_ready(index)

    @abstractmethod
    def answer(self, id_: TrajectoryId, ticket: Ticket) -> Trajectory:
        """What happened in a ticket's episode."""


class InProcessActor(AnsweringActor):
    """Plays the episodes."""

    def __init__(self, owner: Owner, env: ClothbusEnv, snapshots: SnapshotStore) -> None:
        """Prepares an actor.

        Args:
            owner: Asked for tickets.
            env: Played in.
            snapshots: Where the policies of the tickets are.
        """
        super().__init__(owner)
        self._env = env
        self._snapshots = snapshots
        self._policy: tuple[int, ActingPolicy] | None = None

    def answer(self, id_: TrajectoryId, ticket: Ticket) -> Trajectory:
        """Plays a ticket on exactly its policy."""
        return collect(self._env, self._policy_of(ticket.policy_version), ticket, id_)

    def _policy_of(self, version: int) -> ActingPolicy:
        if self._policy is None or self._policy[0] != version:
            weights = self._snapshots.get(version)
            if weights is None:
                raise StorageError(f"snapshots: expected policy version {version}; it is gone")
            preset = self._owner.preset
            policy = Policy.from_bytes(preset.network, weights)
            self._policy = version, collecting_policy(preset.algorithm, policy)
        return self._policy[1]


class InProcessDiscriminators:
    """Label what the owner announces in the calling thread; they follow its journal."""

    def __init__(self, owner: Owner, journal: JournalReader) -> None:
        """Prepares them.

        Args:
            owner: Of a run that imitates.
            journal: The owner's.
        """
        self._owner = owner
        self._journal = journal
        self._labeller = Labeller(owner.preset, ACTOR, secrets.token_hex(8))

    def wait_rewards(self, announced: IterationAnnounced) -> Rewards | None:
        """The rewards of an announced iteration, which are in the journal then."""
        labeller, desk = self._labeller, self._owner.reward_desk
        while labeller.next_offset < self._journal.end_offset:
            for entry in self._journal.read(labeller.next_offset, _BATCH_BYTES):
                labeller.take(entry)
        if labeller.owed is not None:
            rewards = labeller.answer()
            self._owner.receive_rewards(rewards, encode(rewards)).result()
        return desk.rewards_of(announced)
