"""A run that never was: everything a recorder hears of one, in order, for tests and benchmarks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from hashlib import sha256
from pathlib import Path

import numpy as np

from broker_config.codec import encode
from broker_config.journal import Journal
from broker_config.messages import (
    AttemptEnded,
    IterationAnnounced,
    IterationEnded,
    JournalEntry,
    Metrics,
    Presence,
    Rewards,
    RunStarted,
    Snapshot,
    SnapshotTaken,
    Ticket,
    TicketIssued,
    Trajectory,
    TrajectoryId,
    Verdict,
    View,
    generated_digest,
    weights_digest,
)
from broker_config.preset import Preset
from broker_config.recording.recording import Recording
from learner.tickets import make_ticket

Heard = JournalEntry | Snapshot | View | Metrics | Presence
RUN = "never-was"
LIFE = "life"
BEGAN_UNIX_SECS = 1.5e9


class SyntheticRun:
    """A run that imitates, with random pictures; the same for the same seed.

    Attributes:
        entries: Of its journal so far.
    """

    def __init__(self, preset: Preset, weights_bytes: int = 3000, view_bytes: int = 300) -> None:
        self.preset = preset
        self.entries = 0
        self._random = np.random.default_rng(0)
        self._weights_bytes = weights_bytes
        self._view_bytes = view_bytes
        self._views = 0

    def messages(self) -> Iterator[Heard]:
        """Everything, in the order in which a recorder writes it."""
        schedule = self.preset.schedule
        yield Presence("owner", "learner", True)
        yield self._entry("run/1", RunStarted(RUN, 1, self.preset.to_json(), "0.1.0"))
        yield Presence("actor", "actor-0", True)
        yield from self._policy(0)
        for iteration in range(schedule.iterations):
            first = iteration * schedule.episodes_per_iteration
            ids: list[TrajectoryId] = []
            for index in range(first, first + schedule.episodes_per_iteration):
                yield from self._episode(make_ticket(self.preset, index), ids)
            yield from self._rewarded(iteration, ids)
            yield self._metrics(iteration)
            yield from self._policy(iteration + 1)
        yield Presence("actor", "actor-0", False)

    def _policy(self, version: int) -> Iterator[Heard]:
        weights = self._random.bytes(self._weights_bytes)
        digest = weights_digest(weights)
        yield Snapshot(version, 1, self.preset.network, weights, digest)
        absorbed = self.preset.schedule.episodes_before(version)
        taken = SnapshotTaken(version, digest, absorbed)
        yield self._entry(f"snapshot/{version}/{digest[:16]}", taken)

    def _episode(self, ticket: Ticket, ids: list[TrajectoryId]) -> Iterator[Heard]:
        issued = TicketIssued(ticket, "actor-0", LIFE, f"nonce-{ticket.index}")
        yield self._view(ticket, 0)
        yield self._entry(f"ticket/{ticket.index}/{ticket.attempt}", issued)
        for step in range(1, ticket.steps + 1):
            yield self._view(ticket, step)
        id_ = TrajectoryId("actor-0", LIFE, ticket.index)
        ids.append(id_)
        yield self._entry(f"trajectory/{id_}", self._trajectory(id_, ticket))
        ended = AttemptEnded(
            ticket.index, ticket.attempt, Verdict.ACCEPTED, id_, ticket.steps, True, ""
        )
        yield self._entry(f"ended/{id_}", ended)

    def _trajectory(self, id_: TrajectoryId, ticket: Ticket) -> Trajectory:
        shape = (ticket.steps + 1, *self.preset.network.observation_shape)
        return Trajectory(
            id=id_,
            ticket=ticket,
            observations=self._random.integers(0, 256, shape, np.uint8),
            actions=np.zeros(ticket.steps, np.int32),
            rewards=np.zeros(ticket.steps, np.float32),
            terminated=False,
            truncated=True,
            success=False,
            guard=None,
            interrupted=False,
            ended_unix_secs=BEGAN_UNIX_SECS,
        )

    def _rewarded(self, iteration: int, ids: list[TrajectoryId]) -> Iterator[Heard]:
        samples = len(ids) * self.preset.task.horizon
        digest = generated_digest(ids, samples)
        announced = IterationAnnounced(iteration, digest, samples, tuple(ids))
        yield self._entry(f"announced/{iteration}", announced)
        state = self._random.bytes(self._weights_bytes)
        rewards = Rewards(
            "discriminator", LIFE, iteration, digest, np.ones(samples, np.float32), iteration,
            None, state, sha256(state).hexdigest(), {"loss": 0.5},
        )  # fmt: skip
        yield self._entry(f"rewards/{iteration}", rewards)
        ended = IterationEnded(iteration, "ab" * 32, 0.0, 0.0)
        yield self._entry(f"iteration/{iteration}", ended)

    def _view(self, ticket: Ticket, step: int) -> View:
        self._views += 1
        return View(
            "actor-0", LIFE, self._views - 1, ticket.index, ticket.attempt, ticket.policy_version,
            step, 0 if step else None, 0.0 if step else None,
            self._random.bytes(self._view_bytes), "jpeg", BEGAN_UNIX_SECS,
        )  # fmt: skip

    def _metrics(self, sequence: int) -> Metrics:
        return Metrics("owner", "learner", LIFE, sequence, sequence, {"loss": 0.5})

    def _entry(self, name: str, message: object) -> JournalEntry:
        self.entries += 1
        offset = self.entries - 1
        return JournalEntry(offset, name, encode(message), BEGAN_UNIX_SECS + offset)


def record(
    folder: Path,
    heard: Iterable[Heard],
    *,
    segment_bytes: int = 1 << 30,
    flush_every: int = 20,
    is_finished: bool = True,
    incarnation: str = "rec-1",
) -> None:
    """Writes messages as a recorder does."""
    folder.mkdir(exist_ok=True)
    with Recording(folder, RUN, incarnation, segment_bytes) as recording:
        for number, message in enumerate(heard, 1):
            match message:
                case JournalEntry():
                    recording.add_entry(message)
                case Snapshot():
                    recording.add_snapshot(message)
                case _:
                    recording.add_live(message)
            if number % flush_every == 0:
                recording.flush()
        recording.flush()
        if is_finished:
            recording.finish()


def journal(path: Path, heard: Iterable[Heard]) -> None:
    """Makes the journal from which the recording was pulled."""
    with Journal(path) as made:
        entries = [(it.name, it.payload) for it in heard if isinstance(it, JournalEntry)]
        made.append(entries).result(30)
