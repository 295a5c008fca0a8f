"""One step of algorithm 4 in one process: discriminators are updated, and label all of D_G anew."""

from __future__ import annotations

from discriminator.trainer import DiscriminatorReport, Discriminators
from learner.trainer import Trainer


def relabel(trainer: Trainer, discriminators: Discriminators) -> dict[str, DiscriminatorReport]:
    """J epochs on what the memory holds, then a reward for every sample of it."""
    states = trainer.memory.states_after().cpu()  # where discriminators are
    reports = discriminators.update(states)
    trainer.memory.replace_rewards(discriminators.rewards(states))
    return reports
