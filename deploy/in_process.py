"""The same cores in one process without a bus: for experiments, debugging and demonstrations."""

from __future__ import annotations

import secrets
import time

from actors.acting import collecting_policy
from actors.envs import ClothbusEnv
from actors.policy import Policy
from actors.rollout import ActingPolicy, collect
from broker_config.codec import encode
from broker_config.errors import StorageError
from broker_config.messages import Ticket, TicketRequest, TrajectoryId
from learner.owner import Owner
from learner.snapshots import SnapshotStore

ACTOR = "in-process"
IDLE_SECS = 0.1


class InProcessActor:
    """Plays the owner's tickets in the calling thread, one for each call."""

    def __init__(
        self,
        owner: Owner,
        env: ClothbusEnv,
        snapshots: SnapshotStore,
        fixed_policy: ActingPolicy | None = None,
    ) -> None:
        """Prepares an actor.

        Args:
            owner: Asked for tickets.
            env: Played in.
            snapshots: Where the policies of the tickets are.
            fixed_policy: Acts in place of any snapshot: for demonstrations.
        """
        self._owner = owner
        self._env = env
        self._snapshots = snapshots
        self._fixed_policy = fixed_policy
        self._incarnation = secrets.token_hex(8)
        self._sequence = 0
        self._policy: tuple[int, ActingPolicy] | None = None

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
            self._play(reply.ticket)
        return self._owner.is_ready(index)

    def _play(self, ticket: Ticket) -> None:
        id_ = TrajectoryId(ACTOR, self._incarnation, self._sequence)
        self._sequence += 1
        trajectory = collect(self._env, self._policy_of(ticket.policy_version), ticket, id_)
        self._owner.receive(trajectory, encode(trajectory)).result()

    def _policy_of(self, version: int) -> ActingPolicy:
        if self._fixed_policy is not None:
            return self._fixed_policy
        if self._policy is None or self._policy[0] != version:
            weights = self._snapshots.get(version)
            if weights is None:
                raise StorageError(f"snapshots: expected policy version {version}; it is gone")
            preset = self._owner.preset
            policy = Policy.from_bytes(preset.network, weights)
            self._policy = version, collecting_policy(preset.algorithm, policy)
        return self._policy[1]
