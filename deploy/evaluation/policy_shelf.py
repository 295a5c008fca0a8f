"""The policy versions that an evaluator scores: on its own disk before it plays them."""

from __future__ import annotations

import logging
import time

from broker_config.bus import Bus
from broker_config.errors import OwnerUnreachable, Refused, StorageError
from broker_config.messages import Snapshot, SnapshotRequest, weights_digest
from broker_config.preset import SchedulePreset
from learner.snapshots import SnapshotStore

_log = logging.getLogger(__name__)

ASK_TIMEOUT_SECS = 3.0
RETRY_SECS = 0.5


class PolicyShelf:
    """Keeps the untrained policy and the last one of each iteration.

    On the learner's machine the store is the learner's own, and nothing has to be fetched.
    """

    def __init__(self, bus: Bus, store: SnapshotStore, schedule: SchedulePreset) -> None:
        """Prepares to fetch; nothing is asked yet."""
        self._bus = bus
        self._store = store
        self._wanted = schedule.iteration_versions()
        self._gone: set[int] = set()
        self._ask_again_secs = 0.0

    def versions(self) -> list[int]:
        """The versions that can be scored, newest first."""
        return sorted(set(self._store.versions()).intersection(self._wanted), reverse=True)

    @property
    def is_full(self) -> bool:
        """Whether the run's last version is here, after which nothing newer comes."""
        return self._wanted[-1] in self._store.versions()

    def missing(self, newest: int) -> set[int]:
        """The versions up to the newest one that are not here and can still be had."""
        return {it for it in self._wanted if it <= newest} - self._gone - {*self._store.versions()}

    def weights(self, version: int) -> bytes:
        """The weights of a version.

        Raises:
            StorageError: It is not here any more.
        """
        if (weights := self._store.get(version)) is None:
            raise StorageError(
                f"policy version {version}: expected its weights where they were; got nothing; "
                "leave the folder's snapshots alone while it is evaluated"
            )
        return weights

    def fetch(self, newest: Snapshot) -> None:
        """Puts the newest missing version onto the disk; call it again for the next.

        Args:
            newest: The newest snapshot on the bus.

        Raises:
            StorageError: The disk refuses, or the folder holds the policies of another run.
        """
        self._refuse_other_run(newest)
        version = max(self.missing(newest.version), default=None)
        if version is None:
            return
        if version == newest.version:
            self._store.put(version, newest.weights)
        elif time.monotonic() >= self._ask_again_secs:
            self._ask(version)

    def _ask(self, version: int) -> None:
        key, request = self._bus.keys.policy_version(version), SnapshotRequest(version)
        try:
            snapshot = self._bus.ask(key, request, Snapshot, timeout_secs=ASK_TIMEOUT_SECS)
        except Refused as error:
            _log.warning("Policy version %d is not scored: %s", version, error)
            self._gone.add(version)
        except OwnerUnreachable as error:
            _log.debug("%s", error)
            self._ask_again_secs = time.monotonic() + RETRY_SECS
        else:
            self._store.put(version, snapshot.weights)

    def _refuse_other_run(self, newest: Snapshot) -> None:
        if newest.version not in self._wanted:
            return
        ours = self._store.get(newest.version)
        if ours is not None and (digest := weights_digest(ours)) != newest.digest:
            raise StorageError(
                f"policy version {newest.version}: expected {newest.digest[:12]} (of the run); got "
                f"{digest[:12]} in the output folder; choose another folder for this run"
            )
