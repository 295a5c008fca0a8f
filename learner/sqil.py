"""Soft Q imitation learning: what was demonstrated is worth 1, what the policy did itself 0.

Source: Reddy, Dragan and Levine, SQIL: Imitation Learning via Reinforcement Learning with Sparse
Rewards, 2019. Demonstrations stay in the memory for good, and are one half of each minibatch
(`learner/minibatches.py`); the teaching signal is that of soft Q-learning, EDPN's with alpha 0.
Differs: the target network, and how often it is switched, are those of the preset's learner.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from broker_config.errors import MessageError
from broker_config.messages import Trajectory
from learner.trainer import Trainer


def hold_demonstrations(trainer: Trainer, demonstrations: Iterable[Trajectory]) -> None:
    """Loads what is imitated into an empty memory, for good.

    Raises:
        MessageError: There are no demonstrations, or they leave no room for other samples.
    """
    given = list(demonstrations)
    if not given:
        raise MessageError("sqil: expected demonstrations; got none; record some")
    for each in given:
        _add(trainer, each, 1.0)
    trainer.memory.hold()


def add_own(trainer: Trainer, played: Trajectory) -> None:
    """Adds an episode of the policy itself: a reward of the task would be no imitation."""
    _add(trainer, played, 0.0)


def _add(trainer: Trainer, trajectory: Trajectory, reward: float) -> None:
    rewards = np.full(trajectory.steps, reward, np.float32)
    trainer.add(
        trajectory.observations, trajectory.actions, rewards, terminated=trajectory.terminated
    )
