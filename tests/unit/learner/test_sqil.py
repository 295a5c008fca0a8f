"""Soft Q imitation learning: what it learns from, and what stays in its memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from broker_config.errors import MessageError, PresetError
from broker_config.messages import Trajectory
from broker_config.preset import Preset
from deploy.presets import load_preset
from learner.sqil import add_own, hold_demonstrations
from learner.steps.compute import Compute
from learner.steps.graphed_steps import GraphedSteps
from learner.teaching_signal import soft_value
from learner.trainer import Trainer

GAMMA = 0.9
DEMONSTRATED, OWN = 6, 8
SETTINGS = (
    "task.observation_shape=[36,36,1]",
    "task.options.n_joints=1",
    "task.n_actions=4",
    "algorithm.method=sqil",
    "algorithm.sigma=0.0",
    f"algorithm.gamma={GAMMA}",
    "optimiser.name=adam",
    "optimiser.learning_rate=1e-3",
    "optimiser.epsilon=1e-8",
    f"imitation.demonstration_samples={DEMONSTRATED}",
    "imitation.generator_epochs=6",
    "schedule.target_switches=2",
    "schedule.epochs=3",
    f"schedule.memory_samples={OWN}",
    "schedule.minibatch_size=4",
)


def preset_with(*overrides: str) -> Preset:
    return load_preset("reaching-ch4-horizon30", [*SETTINGS, *overrides])


@pytest.fixture
def episode(make_trajectory: Callable[..., Trajectory]) -> Callable[..., Trajectory]:
    """One of noise, with rewards of a task that nothing may be learned from."""

    def make(seed: int, steps: int, action: int | None = None) -> Trajectory:
        generator = np.random.default_rng(seed)
        actions = generator.integers(0, 4, steps).astype(np.int32)
        return replace(
            make_trajectory(steps=steps),
            observations=generator.integers(0, 256, (steps + 1, 36, 36, 1), np.uint8),
            actions=actions if action is None else np.full(steps, action, np.int32),
            rewards=np.full(steps, -7.0, np.float32),
            terminated=False,
            truncated=True,
        )

    return make


def begun(preset: Preset, episode: Callable[..., Trajectory], **compute: object) -> Trainer:
    trainer = Trainer(preset, Compute(**compute))
    hold_demonstrations(trainer, [episode(50, 4), episode(51, 2)])
    return trainer


def test_demonstrations_stay_while_its_own_samples_age(episode: Callable[..., Trajectory]) -> None:
    trainer = begun(preset_with(), episode)
    for seed in range(5):
        add_own(trainer, episode(seed, 5))
    samples = trainer.memory.samples
    assert len(trainer.memory) == DEMONSTRATED + OWN
    assert samples.rewards.tolist() == [1.0] * DEMONSTRATED + [0.0] * OWN
    first = torch.tensor(episode(50, 4).observations[:4])
    assert torch.equal(trainer.memory.minibatch(torch.arange(4)).observations, first)


def test_it_goes_on_bit_identically(episode: Callable[..., Trajectory]) -> None:
    trainer = begun(preset_with(), episode)
    for seed in range(3):
        add_own(trainer, episode(seed, 5))
        trainer.update()
    resumed = Trainer(preset_with("seed=9"))
    resumed.set_state(trainer.get_state())
    for each in (trainer, resumed):
        add_own(each, episode(7, 5))
        each.update()
    assert resumed.weights_bytes() == trainer.weights_bytes()


@pytest.mark.parametrize(
    ("path", "most"), [("winograd", 1e-4), ("graphs", 1e-4), ("winograd-bf16", 0.6)]
)
def test_fast_paths_make_the_same_steps(
    path: str, most: float, episode: Callable[..., Trajectory]
) -> None:
    # Adam's own epsilon, 1e-8, follows the sign of gradients that are rounding alone.
    preset = preset_with("optimiser.epsilon=1e-3")
    reference = begun(preset, episode, path="reference")
    other = begun(preset, episode, path="reference" if path == "graphs" else path)
    if path == "graphs":
        steps = GraphedSteps(other._network, other._optimiser, other._memory, record=run_once)
        other._steps = steps
    before = reference.weights()
    for seed in range(4):  # its own part of the ring wraps
        for trainer in (reference, other):
            add_own(trainer, episode(seed, 5))
            trainer.update()
    assert other.gradient_steps == reference.gradient_steps
    for name, weights in reference.weights().items():
        # What has nothing in common would be at 1.4.
        error = (other.weights()[name] - weights).norm() / (weights - before[name]).norm()
        assert error < most, f"{name}: relative error of what was learned {error:.2g}"


def run_once(program: Callable[[], None]) -> Callable[[], None]:
    program()
    return program


def test_its_teaching_signal_is_that_of_soft_q_learning(
    episode: Callable[..., Trajectory],
) -> None:
    trainer = begun(preset_with("algorithm.eta=2.0"), episode, path="reference")
    add_own(trainer, episode(0, 5))
    with torch.no_grad():
        after = soft_value(trainer._network(trainer.memory.states_after()), 2.0)
        signals = trainer._assess().teaching_signals
    torch.testing.assert_close(signals, trainer.memory.samples.rewards + GAMMA * after)


def test_it_prefers_what_was_demonstrated(episode: Callable[..., Trajectory]) -> None:
    """In the pictures of the demonstrations, where it did something else itself."""
    preset = preset_with("schedule.target_switches=12", "imitation.generator_epochs=36")
    trainer = Trainer(preset)
    demonstrated, own = episode(50, 6, action=2), episode(50, 6, action=1)
    hold_demonstrations(trainer, [demonstrated])
    add_own(trainer, own)
    for _ in range(10):
        trainer.update()
    with torch.no_grad():
        preferences = trainer._network(torch.tensor(demonstrated.observations[:-1]))
    assert bool((preferences[:, 2] > preferences[:, 1]).all())


def test_it_needs_demonstrations_and_samples_of_its_own(
    episode: Callable[..., Trajectory],
) -> None:
    with pytest.raises(MessageError, match="sqil: expected demonstrations; got none"):
        hold_demonstrations(Trainer(preset_with()), [])
    with pytest.raises(MessageError, match="expected samples to learn from; got none"):
        begun(preset_with(), episode).update()
    with pytest.raises(PresetError, match="minibatch_size: expected an even number for sqil"):
        preset_with("schedule.minibatch_size=5")
    with pytest.raises(PresetError, match="sigma: expected 0 for sqil"):
        preset_with("algorithm.sigma=0.1")
    with pytest.raises(PresetError, match="imitation: expected a table that says what sqil"):
        load_preset("reaching-smoke", ["algorithm.method=sqil"])
