"""The loop that joins journal and trainer: absorb the next complete ticket, update, make it known.

The order of commits (each step may be repeated): trajectory journaled -> memory -> D_G announced ->
rewards journaled (these two in imitation only) -> update -> checkpoint -> snapshot stored and
journaled -> the tickets that act on it are issued. After a crash
the loop starts from the newest checkpoint and absorbs the journal's tickets again from there, which
gives the same weights.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from broker_config.errors import PresetError
from broker_config.failpoints import Failpoint, reach
from broker_config.messages import (
    IterationAnnounced,
    IterationEnded,
    Rewards,
    Snapshot,
    SnapshotTaken,
    Trajectory,
    weights_digest,
)
from discriminator.real_states import require_real_states
from learner.checkpoint import CheckpointStore
from learner.generated import GeneratedSamples
from learner.owner import Owner
from learner.recorded import Demonstrations, first_samples
from learner.snapshots import SnapshotStore
from learner.sqil import add_own, hold_demonstrations
from learner.trainer import Trainer, UpdateReport

_log = logging.getLogger(__name__)

WAIT_SECS = 0.5
"""How often the loop looks up while nothing arrives."""


@dataclass(frozen=True)
class PolicyReady:
    """A policy version exists, is stored and journaled."""

    snapshot: Snapshot
    absorbed: int
    """Tickets that were in the memory when it was trained."""
    report: UpdateReport | None
    """None when it was restored or is the untrained policy."""


@dataclass(frozen=True)
class EpisodeAbsorbed:
    """A ticket's trajectories are in the memory, and learned from if it was their turn."""

    index: int
    iteration: int
    return_: float
    success: bool
    steps: int
    policy_lag: int
    """Updates made since the version on which the episode acted."""


@dataclass(frozen=True)
class RewardsAwaited:
    """An iteration is collected; discriminators are asked to label every sample of D_G."""

    iteration: int
    samples: int


@dataclass(frozen=True)
class IterationLabelled:
    """Every sample of D_G has the reward that discriminators gave it in this iteration."""

    absorbed: int
    """Tickets that D_G is of."""
    rewards: Rewards


LearningEvent = PolicyReady | EpisodeAbsorbed | RewardsAwaited | IterationLabelled


@dataclass(frozen=True)
class _Outcome:
    """What an iteration's record needs of an episode."""

    ids: tuple[str, ...]
    return_: float
    success: bool


def _outcome_of(parts: Sequence[Trajectory]) -> _Outcome:
    ids = tuple(str(part.id) for part in parts)
    return _Outcome(ids, sum(part.return_ for part in parts), parts[-1].success)


class LearningLoop:
    """Iterating over it runs the learner; statistics and publishing stay with the caller."""

    def __init__(
        self,
        owner: Owner,
        trainer: Trainer,
        checkpoints: CheckpointStore,
        snapshots: SnapshotStore,
        demonstrations: Demonstrations | None = None,
        wait_ready: Callable[[int], bool] | None = None,
        wait_rewards: Callable[[IterationAnnounced], Rewards | None] | None = None,
    ) -> None:
        """Joins the parts.

        Args:
            owner: Of the run.
            trainer: New; it is restored from the newest checkpoint if there is one.
            checkpoints: Of the run.
            snapshots: Of the run.
            demonstrations: For Algorithm 2 or for discriminators, if the preset asks for them and
                the run is new.
            wait_ready: Waits, for a while, until a ticket is ready, and says whether it is. Without
                a bus this is where the episode is played.
            wait_rewards: Waits, for a while, for an announced iteration's rewards. Without a bus
                this is where discriminators label it.
        """
        self._wait_ready = wait_ready or (lambda index: owner.wait_ready(index, WAIT_SECS))
        self._wait_rewards = wait_rewards or (lambda it: owner.wait_rewards(it, WAIT_SECS))
        self._owner = owner
        self._trainer = trainer
        self._checkpoints = checkpoints
        self._snapshots = snapshots
        self._demonstrations = demonstrations
        self._schedule = owner.preset.schedule
        self._absorbed = 0
        self._version = 0
        self._report: UpdateReport | None = None
        self._outcomes: dict[int, _Outcome] = {}
        """Of this iteration's episodes, as far as this process has absorbed them."""
        preset = owner.preset
        samples = GeneratedSamples(preset.schedule.memory_samples)
        self._generated = samples if preset.has_discriminators else None
        """What the memory holds, where discriminators label it."""

    def __iter__(self) -> Iterator[LearningEvent]:
        """Yields what happens until the run is complete or was stopped."""
        if not self._restore():
            self._initialise()
            self._save_checkpoint()
        yield self._make_known()
        while self._absorbed < self._schedule.episodes:
            if not self._wait_ready(self._absorbed):
                if self._owner.is_stopping:
                    return
                continue
            yield self._absorb()
            reach(Failpoint.EPISODE_ABSORBED)
            if self._schedule.updates_after(self._absorbed - 1):
                if self._generated is not None and not (yield from self._label(self._generated)):
                    return  # stopped: the rewards are waited for again when the run goes on
                self._report = self._trainer.update()
                self._version += 1
                reach(Failpoint.POLICY_UPDATED)
                self._save_checkpoint()
                yield self._make_known()

    # Start ------------------------------------------------------------------------------------

    def _restore(self) -> bool:
        checkpoint = self._checkpoints.latest()
        if checkpoint is None:
            return False
        self._trainer.set_state(checkpoint.state)
        self._absorbed = int(checkpoint.extra["absorbed"])
        self._version = int(checkpoint.extra["version"])
        if self._generated is not None:
            self._generated.restore(checkpoint.extra["generated"])
        _log.info("Resumed at policy version %d after %d tickets", self._version, self._absorbed)
        return True

    def _initialise(self) -> None:
        """Demonstrations into the record, and where Algorithm 2 asks for it, learned from."""
        preset = self._owner.preset
        wanted = preset.initialisation or preset.imitation
        if wanted is None:
            if self._demonstrations:
                raise PresetError(
                    f"{preset.name}: expected an [initialisation] or [imitation] table to use the "
                    "demonstrations by; add it to the preset, or leave the demonstrations out"
                )
            return
        kept = self._demonstrations or self._owner.given.read()
        if kept.samples < wanted.demonstration_samples:
            raise PresetError(
                f"{preset.name}: expected {wanted.demonstration_samples} demonstration "
                f"samples; got {kept.samples}; make more with `clothbus demos make` and name the "
                "folder with --demonstrations"
            )
        given = first_samples(kept, wanted.demonstration_samples)
        if preset.imitation is not None:
            if preset.has_discriminators:
                require_real_states(preset.imitation, given.trajectories, given.marks)
            else:
                hold_demonstrations(self._trainer, given.trajectories)
            # Discriminators read them in the journal: there are exactly those that they learn from.
            self._owner.given.keep(given)
            return
        if self._demonstrations:
            self._owner.given.keep(self._demonstrations)
        for item in given.trajectories:
            self._add(item)
        self._report = self._trainer.initialise()

    # One step ---------------------------------------------------------------------------------

    def _absorb(self) -> EpisodeAbsorbed:
        index = self._absorbed
        parts = self._owner.trajectories(index)
        for part in parts:
            self._add(part)
            if self._generated is not None:
                self._generated.add(part.id, part.steps)
        outcome = self._outcomes[index] = _outcome_of(parts)
        self._absorbed += 1
        return EpisodeAbsorbed(
            index=index,
            iteration=index // self._schedule.episodes_per_iteration,
            return_=outcome.return_,
            success=outcome.success,
            steps=sum(part.steps for part in parts),
            policy_lag=self._version - parts[0].ticket.policy_version,
        )

    def _add(self, trajectory: Trajectory) -> None:
        if self._owner.preset.algorithm.method == "sqil":
            add_own(self._trainer, trajectory)
            return
        self._trainer.add(
            trajectory.observations,
            trajectory.actions,
            trajectory.rewards,
            terminated=trajectory.terminated,
        )

    def _label(self, generated: GeneratedSamples) -> Generator[LearningEvent, None, bool]:
        """Algorithm 4: every sample of D_G gets a reward; False if the run is stopped before."""
        announced = generated.announce(self._absorbed // self._schedule.episodes_per_iteration - 1)
        self._owner.reward_desk.announce(announced)
        reach(Failpoint.ITERATION_ANNOUNCED)
        yield RewardsAwaited(announced.iteration, announced.samples)
        while (rewards := self._wait_rewards(announced)) is None:
            if self._owner.is_stopping:
                return False
        self._trainer.memory.replace_rewards(torch.tensor(rewards.rewards))
        yield IterationLabelled(self._absorbed, rewards)
        return True

    # After a step -----------------------------------------------------------------------------

    def _save_checkpoint(self) -> None:
        extra: dict[str, object] = {"absorbed": self._absorbed, "version": self._version}
        if self._generated is not None:
            extra["generated"] = self._generated.to_plain()
        self._checkpoints.save(self._trainer.get_state(), extra)
        reach(Failpoint.CHECKPOINT_SAVED)

    def _make_known(self) -> PolicyReady:
        """Stores and journals the current policy; doing it twice changes nothing."""
        weights = self._trainer.weights_bytes()
        snapshot = Snapshot(
            self._version,
            self._owner.epoch,
            self._owner.preset.network,
            weights,
            weights_digest(weights),
        )
        self._snapshots.put(snapshot.version, weights)
        reach(Failpoint.SNAPSHOT_STORED)
        per_iteration = self._schedule.episodes_per_iteration
        if self._absorbed and self._absorbed % per_iteration == 0:
            self._owner.iteration_ended(self._iteration(self._absorbed // per_iteration - 1))
            reach(Failpoint.ITERATION_JOURNALED)
        self._owner.policy_ready(SnapshotTaken(self._version, snapshot.digest, self._absorbed))
        reach(Failpoint.SNAPSHOT_JOURNALED)
        # Whoever records gets every version, however far behind it is.
        pinned = frozenset(self._schedule.iteration_versions())
        wanted = pinned | self._owner.followers.missing_versions()
        self._snapshots.retain(self._schedule.policy_lag + 2, wanted)
        report, self._report = self._report, None
        return PolicyReady(snapshot, self._absorbed, report)

    def _iteration(self, number: int) -> IterationEnded:
        per_iteration = self._schedule.episodes_per_iteration
        tickets = range(number * per_iteration, (number + 1) * per_iteration)
        episodes = [
            self._outcomes.pop(index)
            if index in self._outcomes
            else _outcome_of(self._owner.trajectories(index))
            for index in tickets
        ]
        ids = "\n".join(id_ for episode in episodes for id_ in episode.ids)
        return IterationEnded(
            number,
            hashlib.sha256(ids.encode()).hexdigest(),
            float(np.mean([episode.return_ for episode in episodes])),
            float(np.mean([episode.success for episode in episodes])),
        )
