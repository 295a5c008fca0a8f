"""The learner's core: a local memory, a network, and UpdatePNetwork. It knows no bus.

Source: algorithms 1 and 2. Each sub-problem of an update trains against a target network that is
frozen, and switches it at its end. At the beginning of a sub-problem target network and network are
therefore equal: the teaching signals of the whole memory are computed there, once, and no second
network is kept. This holds for DPN, EDPN and DQN alike, which differ in the teaching signal only.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from actors.networks import PreferenceNetwork, build_network, weights_to_bytes
from broker_config.errors import MessageError, StorageError
from broker_config.preset import Preset
from broker_config.seeds import (
    AUGMENTATION_STREAM,
    SHUFFLING_STREAM,
    WEIGHTS_STREAM,
    stream_seed,
)
from learner.assessment import Assessment, assess, double_q_signals
from learner.augmentation import augmented
from learner.memory import LocalMemory
from learner.minibatches import balanced, shuffled
from learner.steps.compute import EVALUATED_AT_ONCE, ON_CPU, Compute, TrainingPath
from learner.steps.eager_steps import EagerSteps, GradientSteps
from learner.steps.graphed_steps import GraphedSteps, exact_float32
from learner.steps.optimiser import FusedAdam, build_optimiser, named_state, overwrite
from learner.teaching_signal import bellman_error

_EVALUATED_AT_ONCE = 2 * EVALUATED_AT_ONCE
"""Pictures for which preferences are computed at a time; a multiple of what steps take at once."""
_STEPS_AT_ONCE = 32
"""Gradient steps between two calls of `on_step`: seconds at most, even of large minibatches."""


@dataclass(frozen=True)
class UpdateReport:
    """What an update did. Values and entropies are those of the updated network on the memory."""

    losses: tuple[float, ...]
    """Mean loss over the gradient steps of each sub-problem."""
    gradient_steps: int
    mean_value: float
    """Mean V(s): soft value, or E over the epsilon-greedy policy of Q for DQN."""
    mean_entropy: float
    """Mean entropy in nats: of the epsilon-greedy policy for DQN, else of the softmax policy."""
    bellman_error: float
    """Eq. 3.6, mean over the sub-problems."""
    relative_bellman_error: float
    """The same in standard deviations of V."""
    secs: float

    @property
    def loss(self) -> float:
        """Mean loss of the last sub-problem."""
        return self.losses[-1]


@dataclass(frozen=True)
class TrainerState:
    """All that a trainer's future depends on, besides its preset."""

    tensors: Mapping[str, Tensor]
    """Contiguous, on the CPU."""
    counters: Mapping[str, int]


@dataclass
class _Counters:
    updates: int = 0
    target_switches: int = 0
    gradient_steps: int = 0


class Trainer:
    """Improves a network from trajectories.

    Its results are a function of the preset and of the calls made, bit for bit on one type of CPU
    with one number of threads; on a GPU they are equal up to rounding.
    """

    def __init__(
        self,
        preset: Preset,
        compute: Compute = ON_CPU,
        on_step: Callable[[], None] = lambda: None,
    ) -> None:
        """Makes the untrained policy.

        Args:
            preset: What is learned, and how.
            compute: Where, and by which path.
            on_step: Called every few seconds of an update, to show that it gets on.
        """
        self._preset = preset
        self._on_step = on_step
        algorithm = preset.algorithm
        self._network = build_network(
            preset.network,
            stream_seed(preset.seed, WEIGHTS_STREAM),
            starts_at_zero_value=not algorithm.is_epsilon_greedy,
        ).to(compute.device)
        self._optimiser = build_optimiser(preset.optimiser, self._network)
        self._memory = LocalMemory(_capacity(preset), preset.task.observation_shape, compute.device)
        self._shuffling, self._augmenting = (
            torch.Generator().manual_seed(stream_seed(preset.seed, stream))
            for stream in (SHUFFLING_STREAM, AUGMENTATION_STREAM)
        )
        self._counters = _Counters()
        self._steps, self._evaluate = _make_steps(
            compute.chosen_path, self._network, self._optimiser, self._memory
        )

    @property
    def memory(self) -> LocalMemory:
        """The local memory D."""
        return self._memory

    @property
    def gradient_steps(self) -> int:
        """Gradient steps made since the beginning."""
        return self._counters.gradient_steps

    def add(
        self,
        observations: NDArray[np.uint8],
        actions: NDArray[np.int32],
        rewards: NDArray[np.float32],
        terminated: bool,
    ) -> None:
        """Adds a trajectory to the memory; see `LocalMemory.add`.

        One that has reached the horizon has terminated, too, where the preset ends there.
        """
        out_of_range = (actions < 0) | (actions >= self._preset.task.n_actions)
        if out_of_range.any():
            raise MessageError(
                f"trajectory.actions: expected 0 to {self._preset.task.n_actions - 1}; got "
                f"{actions[out_of_range][0]}; actor and learner run different presets"
            )
        is_whole = len(actions) >= self._preset.task.horizon
        ended = terminated or (is_whole and self._preset.algorithm.ends_at_horizon)
        self._memory.add(observations, actions, rewards, ended)

    def initialise(self) -> UpdateReport:
        """Trains on the demonstrations that were added, for K target switches.

        Source: algorithm 2.

        Raises:
            MessageError: The preset has no initialisation, or the memory is empty.
        """
        if self._preset.initialisation is None:
            raise MessageError(
                f"{self._preset.name}: expected an [initialisation] table; got none; add it"
            )
        return self._learn(self._preset.initialisation.target_switches, n_updates=0)

    def update(self, target_switches: int | None = None) -> UpdateReport:
        """UpdatePNetwork(N): N sub-problems, each against a frozen target network.

        A sub-problem is U epochs over shuffled minibatches. A memory of n samples has
        floor(n / minibatch) of them in an epoch, as B = E / minibatch in algorithm 1 (450 / 32 is
        14); the samples left over are others in each epoch. A memory that is smaller than a
        minibatch is one smaller minibatch. Where the memory holds some samples for good, they are
        one half of each minibatch: see `balanced`.

        Source: algorithm 1.

        Args:
            target_switches: N; the preset's where None.

        Raises:
            MessageError: The memory is empty, or N is less than 1.
        """
        N = self._preset.schedule.target_switches if target_switches is None else target_switches
        report = self._learn(N, n_updates=self._counters.updates + 1)
        self._counters.updates += 1
        return report

    def _learn(self, N: int, n_updates: int) -> UpdateReport:
        """N sub-problems; values are then those of the policy that has had so many updates."""
        if N < 1:
            raise MessageError(f"target_switches: expected at least 1; got {N}")
        if len(self._memory) == self._memory.n_held:
            raise MessageError("memory: expected samples to learn from; got none; add trajectories")
        began_secs = time.perf_counter()
        steps_before = self._counters.gradient_steps
        losses, errors = [], []
        assessment = self._assess(n_updates)
        for _ in range(N):
            losses.append(self._solve_subproblem(assessment))
            targets = assessment.bellman_targets
            assessment = self._assess(n_updates)
            errors.append(bellman_error(assessment.values, targets))
        return UpdateReport(
            losses=tuple(loss.item() for loss in losses),
            gradient_steps=self._counters.gradient_steps - steps_before,
            mean_value=assessment.values.mean().item(),
            mean_entropy=assessment.mean_entropy.item(),
            bellman_error=sum(error.absolute.item() for error in errors) / N,
            relative_bellman_error=sum(error.relative.item() for error in errors) / N,
            secs=time.perf_counter() - began_secs,
        )

    def weights(self) -> dict[str, Tensor]:
        """A copy of the network's weights, on the CPU."""
        return {
            name: tensor.detach().to("cpu", copy=True)
            for name, tensor in self._network.state_dict().items()
        }

    def weights_bytes(self) -> bytes:
        """The network's weights as a snapshot carries them."""
        return weights_to_bytes(self._network.state_dict())

    def get_state(self) -> TrainerState:
        """A copy of everything that `set_state` needs to go on bit-identically."""
        tensors = {f"memory.{name}": part for name, part in self._memory.get_state().items()}
        for name, tensor in self._trained_tensors().items():
            tensors[name] = tensor.detach().to("cpu", copy=True).contiguous()
        for name, generator in self._generators().items():
            tensors[name] = generator.get_state()
        return TrainerState(tensors, asdict(self._counters))

    def set_state(self, state: TrainerState) -> None:
        """Goes back to what `get_state` gave.

        Raises:
            StorageError: The state is not one of a trainer with this preset.
        """
        tensors = dict(state.tensors)
        memory = {
            name.removeprefix("memory."): tensors.pop(name)
            for name in list(tensors)
            if name.startswith("memory.")
        }
        generators = self._generators()
        drawn = {name: tensors.pop(name) for name in generators if name in tensors}
        counters = asdict(self._counters)
        if drawn.keys() != generators.keys() or state.counters.keys() != counters.keys():
            raise StorageError(
                f"trainer state: expected {', '.join([*generators, *counters])}; got "
                f"{', '.join([*drawn, *state.counters])}; the checkpoint is of another version"
            )
        self._memory.check_valid(memory)
        overwrite(self._trained_tensors(), tensors, "trainer state")
        self._memory.set_state(memory)
        for name, generator in generators.items():
            generator.set_state(drawn[name])
        self._counters = _Counters(**state.counters)

    def _generators(self) -> dict[str, torch.Generator]:
        """By their names in a state."""
        if self._preset.augmentation is None:
            return {"shuffling": self._shuffling}
        return {"shuffling": self._shuffling, "augmenting": self._augmenting}

    def _trained_tensors(self) -> dict[str, Tensor]:
        network = {f"network.{name}": part for name, part in self._network.named_parameters()}
        optimiser = {
            f"optimiser.{name}": part for name, part in named_state(self._optimiser, self._network)
        }
        return network | optimiser

    def _solve_subproblem(self, frozen: Assessment) -> Tensor:
        """Makes U epochs against a frozen target network; returns the mean loss, f32[]."""
        schedule = self._preset.schedule
        chooses_itself = self._preset.algorithm.method == "double-dqn"
        self._counters.target_switches += 1
        if schedule.subproblem_loss_threshold == 0 and not chooses_itself:
            return self._run_epochs(schedule.epochs, frozen.teaching_signals).mean()
        losses = []
        for _ in range(schedule.epochs):
            signals = frozen.teaching_signals
            if chooses_itself:
                signals = self._double_q_signals(frozen.preferences)
            losses.append(self._run_epochs(1, signals))
            if losses[-1].mean().item() < schedule.subproblem_loss_threshold:
                break
        return torch.cat(losses).mean()

    def _run_epochs(self, n_epochs: int, teaching_signals: Tensor) -> Tensor:
        epochs = [self._draw_epoch() for _ in range(n_epochs)]
        preset = self._preset.augmentation
        if preset is None:
            return self._step_through(torch.cat(epochs), teaching_signals)
        change = partial(augmented, preset=preset, generator=self._augmenting)
        losses = []
        for epoch in epochs:
            self._memory.change_pictures(change)
            losses.append(self._step_through(epoch, teaching_signals))
        return torch.cat(losses)

    def _step_through(self, minibatches: Tensor, teaching_signals: Tensor) -> Tensor:
        self._counters.gradient_steps += len(minibatches)
        losses = []
        for batches in torch.split(minibatches, _STEPS_AT_ONCE):
            with self._numerics():
                losses.append(self._steps.run(batches, teaching_signals))
            self._on_step()
        return torch.cat(losses)

    def _draw_epoch(self) -> Tensor:
        n_held, n_samples = self._memory.n_held, len(self._memory)
        batch_size = self._preset.schedule.minibatch_size
        if n_held:
            return balanced(n_held, n_samples, batch_size, self._shuffling)
        return shuffled(n_samples, batch_size, self._shuffling)

    @torch.no_grad()
    def _double_q_signals(self, frozen: Tensor) -> Tensor:
        """Teaching signals of double DQN: the network as it is now chooses, once in an epoch."""
        return double_q_signals(
            self._preset.algorithm, self._memory.samples, frozen, self._evaluate_frames()
        )

    @torch.no_grad()
    def _assess(self, n_updates: int | None = None) -> Assessment:
        """Values of the policy that acts after so many updates; after the next one if None."""
        epsilon = self._epsilon(n_updates)
        return assess(
            self._preset.algorithm, self._memory.samples, self._evaluate_frames(), epsilon
        )

    @torch.no_grad()
    def _evaluate_frames(self) -> Tensor:
        """P(s, a) of every picture in the memory, f32[F, A]: each is s of one, s' of another."""
        with self._numerics():
            parts = [
                self._evaluate(self._memory.live_frames(start, start + _EVALUATED_AT_ONCE))
                for start in range(0, self._memory.n_frames, _EVALUATED_AT_ONCE)
            ]
        return torch.cat(parts)

    def _numerics(self) -> AbstractContextManager[None]:
        is_cuda = self._memory.device.type == "cuda"
        return exact_float32() if is_cuda else contextlib.nullcontext()

    def _epsilon(self, n_updates: int | None = None) -> float:
        """Probability of a random action after so many updates; after the next one if None."""
        exploration, schedule = self._preset.exploration, self._preset.schedule
        if exploration is None or not self._preset.algorithm.is_epsilon_greedy:
            return 0.0
        per_update = 1 if schedule.update_every == "episode" else schedule.episodes_per_iteration
        acting = self._counters.updates + 1 if n_updates is None else n_updates
        return exploration.epsilon(acting * per_update)


def _capacity(preset: Preset) -> int:
    """Samples that the memory has room for: those of D, beside what SQIL keeps for good."""
    kept = 0
    if preset.algorithm.method == "sqil":
        assert preset.imitation is not None  # or the preset would have been refused
        kept = preset.imitation.demonstration_samples
    return kept + preset.schedule.memory_samples


def _make_steps(
    path: TrainingPath, network: PreferenceNetwork, optimiser: FusedAdam, memory: LocalMemory
) -> tuple[GradientSteps, Callable[[Tensor], Tensor]]:
    """What makes gradient steps, and what computes P(s, a) of pictures."""
    match path:
        case "graphs":
            return GraphedSteps(network, optimiser, memory), network
        case "reference":
            return EagerSteps(network, optimiser, memory), network
        case "winograd" | "winograd-bf16":
            # Not above: it imports numba, for which processes that make no steps need not wait.
            from learner.steps.product_steps import ProductEvaluation, ProductSteps

            factors = torch.bfloat16 if path == "winograd-bf16" else torch.float32
            steps = ProductSteps(network, optimiser, memory, factors)
            return steps, ProductEvaluation(network, factors)
