"""Gradient steps per second: the trainer beside the loop as the source's algorithm 1 is written.

    make bench

Prints a ratio; both sides run in turn in one process with one thread.
"""

from __future__ import annotations

import time

import numpy as np
import torch

from broker_config.preset import Preset
from deploy.presets import load_preset
from learner.trainer import Trainer

ROUNDS = 3
PRESET = load_preset(
    "reaching-ch3", ["schedule.epochs=2", "optimiser.name=adam", "optimiser.epsilon=1e-8"]
)


def filled(preset: Preset) -> Trainer:
    trainer = Trainer(preset)
    generator = np.random.default_rng(0)
    for _ in range(15):
        trainer.add(
            generator.integers(0, 256, (31, *preset.task.observation_shape), np.uint8),
            generator.integers(0, preset.task.n_actions, 30).astype(np.int32),
            generator.normal(size=30).astype(np.float32),
            terminated=False,
        )
    return trainer


class AsWritten:
    """Teaching signals in each minibatch from a second network; plain convolutions and Adam."""

    def __init__(self) -> None:
        self.online, self.target = self._network(), self._network()
        self.optimiser = torch.optim.Adam(self.online.parameters(), 2.5e-4)
        self.states = torch.randint(0, 256, (450, 84, 84, 1), dtype=torch.uint8)
        self.next_states = torch.randint(0, 256, (450, 84, 84, 1), dtype=torch.uint8)
        self.actions = torch.randint(0, 25, (450,))
        self.rewards = torch.randn(450)

    @staticmethod
    def _network() -> torch.nn.Module:
        return torch.nn.Sequential(
            torch.nn.Conv2d(1, 32, 8, 4), torch.nn.ReLU(),
            torch.nn.Conv2d(32, 64, 4, 2), torch.nn.ReLU(),
            torch.nn.Conv2d(64, 64, 3, 1), torch.nn.ReLU(), torch.nn.Flatten(),
            torch.nn.Linear(3136, 512), torch.nn.ReLU(), torch.nn.Linear(512, 25),
        )  # fmt: skip

    def _preferences(self, network: torch.nn.Module, states: torch.Tensor) -> torch.Tensor:
        outputs: torch.Tensor = network(states.permute(0, 3, 1, 2).float() / 255)
        return outputs

    def steps(self, count: int) -> None:
        for _ in range(count):
            batch = torch.randint(0, 450, (32,))
            with torch.no_grad():
                now = self._preferences(self.target, self.states[batch])
                later = self._preferences(self.target, self.next_states[batch])
                chosen = now.gather(1, self.actions[batch, None])[:, 0]
                signal = chosen - now.logsumexp(1) + self.rewards[batch] + 0.95 * later.logsumexp(1)
            outputs = self._preferences(self.online, self.states[batch])
            loss = torch.nn.functional.mse_loss(
                outputs.gather(1, self.actions[batch, None])[:, 0], signal
            )
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()


def test_trainer_beside_the_loop_as_written() -> None:
    torch.set_num_threads(1)
    trainer, as_written = filled(PRESET), AsWritten()
    steps = trainer.update().gradient_steps
    as_written.steps(5)
    ratios = []
    for _ in range(ROUNDS):
        began_secs = time.process_time()
        trainer.update()
        middle_secs = time.process_time()
        as_written.steps(steps)
        ours_secs, theirs_secs = middle_secs - began_secs, time.process_time() - middle_secs
        ratios.append(theirs_secs / ours_secs)
        print(f"trainer {steps / ours_secs:.1f} steps/s, as written {steps / theirs_secs:.1f}")
    print(f"trainer / as written: median {np.median(ratios):.2f} of {ROUNDS}, CPU time")
