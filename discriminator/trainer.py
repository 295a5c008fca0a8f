"""The discriminators' core: D_E and D_T are trained, and label states with rewards. No bus.

Source: algorithm 4. Its positives are states alone: what was demonstrated for D_E, targets for D_T.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import safetensors.torch
import torch
from torch import Tensor

from broker_config.errors import MessageError, StorageError
from broker_config.preset import DiscriminatorPreset, ImitationPreset, Preset
from broker_config.seeds import (
    EXPERT_DISCRIMINATOR_STREAM,
    TARGET_DISCRIMINATOR_STREAM,
    stream_seed,
)
from discriminator.augmentation import augmented
from discriminator.losses import (
    accuracy,
    discriminator_loss,
    gradient_penalty,
    non_negative_loss,
)
from discriminator.networks import as_input, build_discriminator, logits_of
from discriminator.rewards import join_rewards

Positives = Literal["expert", "target"]

_STREAMS: dict[Positives, int] = {
    "expert": EXPERT_DISCRIMINATOR_STREAM,
    "target": TARGET_DISCRIMINATOR_STREAM,
}


def taking_part(imitation: ImitationPreset) -> tuple[Positives, ...]:
    """The discriminators of an imitation, by what is real to them."""
    if imitation.discriminators == "both":
        return ("expert", "target")
    return (imitation.discriminators,)


@dataclass(frozen=True)
class DiscriminatorReport:
    """What an update did to one discriminator."""

    loss: float
    """Mean over the last epoch's minibatches."""
    accuracy: float
    """Portion told apart, over the last epoch."""
    epochs: int


class Discriminators:
    """Those that take part in an imitation: D_E, D_T or both."""

    def __init__(
        self,
        preset: Preset,
        real: Mapping[Positives, Tensor],
        on_step: Callable[[], None] = lambda: None,
    ) -> None:
        """Makes untrained discriminators.

        Args:
            preset: With an [imitation] table.
            real: Pictures u8[n, H, W, C] of demonstrated states and of target states, as far as
                the preset's discriminators need them.
            on_step: Called after every minibatch, to show that an update gets on.

        Raises:
            MessageError: Pictures are missing, none, or of another shape or dtype.
        """
        assert preset.imitation is not None  # who imitates, has a table
        self._imitation: ImitationPreset = preset.imitation
        shape = preset.task.observation_shape
        self._each = {
            name: _Discriminator(
                _checked(name, real.get(name), shape),
                preset.imitation.discriminator,
                stream_seed(preset.seed, _STREAMS[name]),
                preset.imitation.discriminator.target_prior if name == "target" else 0.0,
                on_step,
            )
            for name in taking_part(preset.imitation)
        }

    @property
    def names(self) -> tuple[str, ...]:
        """Of those that take part."""
        return tuple(self._each)

    def update(self, generated: Tensor) -> dict[str, DiscriminatorReport]:
        """J epochs of each, on the states that the policy has reached.

        Args:
            generated: u8[n, H, W, C], the state after each sample of D_G.
        """
        epochs = self._imitation.discriminator_epochs
        return {name: it.update(generated, epochs) for name, it in self._each.items()}

    def logits(self, states: Tensor) -> dict[str, Tensor]:
        """Of each discriminator, f32[n].

        Args:
            states: u8[n, H, W, C].
        """
        return {name: logits_of(it.network, states) for name, it in self._each.items()}

    def rewards(self, states: Tensor) -> Tensor:
        """The reward of each transition into these states, f32[n]: eq. 4.3.

        Args:
            states: u8[n, H, W, C]: all of D_G, where rewards are centred over it.
        """
        return join_rewards(list(self.logits(states).values()), self._imitation.discriminator)

    def weights_bytes(self) -> bytes:
        """All networks' weights as a snapshot carries them."""
        return safetensors.torch.save(network_weights(self.get_state()))

    def get_state(self) -> dict[str, Tensor]:
        """Everything that `set_state` needs to go on bit-identically."""
        return {
            f"{name}.{part}": tensor
            for name, it in self._each.items()
            for part, tensor in it.get_state().items()
        }

    def set_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes back to what `get_state` gave.

        Raises:
            StorageError: The state is not one of discriminators like these.
        """
        expected = self.get_state()
        if expected.keys() != state.keys() or any(
            expected[name].shape != state[name].shape for name in expected
        ):
            raise StorageError(
                f"discriminators' state: expected the tensors of {', '.join(self.names)} of this "
                "preset; got others; the checkpoint belongs to another preset"
            )
        for name, it in self._each.items():
            prefix = f"{name}."
            it.set_state(
                {
                    part.removeprefix(prefix): tensor
                    for part, tensor in state.items()
                    if part.startswith(prefix)
                }
            )


def network_weights(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The networks' part of a state of `get_state`; names begin with `expert.` or `target.`."""
    parts = ((name.split(".", 2), tensor) for name, tensor in state.items())
    return {
        f"{path[0]}.{path[2]}": tensor.contiguous()
        for path, tensor in parts
        if path[1] == "network"
    }


class _Discriminator:
    """One network and what is real to it."""

    def __init__(
        self,
        real: Tensor,
        preset: DiscriminatorPreset,
        seed: int,
        prior: float,
        on_step: Callable[[], None],
    ) -> None:
        self._real, self._preset, self._prior, self._on_step = real, preset, prior, on_step
        height, width, channels = real.shape[1:]
        self.network = build_discriminator(
            (height, width, channels), seed, spectral_norm=preset.spectral_norm
        )
        self._optimiser = torch.optim.Adam(
            self.network.parameters(), preset.learning_rate, (preset.adam_beta1, 0.999)
        )
        self._generator = torch.Generator().manual_seed(seed)

    def update(self, generated: Tensor, most_epochs: int) -> DiscriminatorReport:
        """So many epochs, or fewer where the preset ends them by accuracy."""
        epochs, right = 0, 0.0
        while epochs < most_epochs and right <= self._preset.most_accuracy:
            loss, right = self._run_epoch(generated)
            epochs += 1
        return DiscriminatorReport(loss, right, epochs)

    def _run_epoch(self, generated: Tensor) -> tuple[float, float]:
        """A pass over what is real, in minibatches with as many generated states."""
        size = self._preset.minibatch_size
        order = torch.randperm(len(self._real), generator=self._generator)
        # A last minibatch is filled up with others: all are balanced and of one size.
        missing = -len(order) % size
        filling = torch.randint(len(self._real), (missing,), generator=self._generator)
        losses, portions = [], []
        for batch in torch.cat((order, filling)).view(-1, size):
            picked = torch.randint(len(generated), (size,), generator=self._generator)
            loss, portion = self._step(self._real[batch], generated[picked])
            self._on_step()
            losses.append(loss)
            portions.append(portion)
        return sum(losses) / len(losses), sum(portions) / len(portions)

    def _step(self, real: Tensor, generated: Tensor) -> tuple[float, float]:
        real_pictures, generated_pictures = (
            augmented(as_input(states), self._preset, self._generator)
            for states in (real, generated)
        )
        logits = self.network(torch.cat((generated_pictures, real_pictures)))
        of_generated, of_real = logits[: len(generated)], logits[len(generated) :]
        preset = self._preset
        if self._prior > 0:
            loss = non_negative_loss(of_generated, of_real, self._prior)
        else:
            loss = discriminator_loss(of_generated, of_real)
        total = loss
        if preset.gradient_penalty > 0:
            total = loss + preset.gradient_penalty * gradient_penalty(self.network, real_pictures)
        self._optimiser.zero_grad()
        total.backward()  # type: ignore[no-untyped-call]
        self._optimiser.step()
        return loss.item(), accuracy(of_generated.detach(), of_real.detach())

    def get_state(self) -> dict[str, Tensor]:
        """Weights, the optimiser's state and the random state."""
        state = {f"network.{name}": it.clone() for name, it in self.network.state_dict().items()}
        for name, parameter in self.network.named_parameters():
            kept = self._optimiser.state.get(parameter) or _fresh_state(parameter)
            state |= {f"optimiser.{name}.{part}": kept[part].clone() for part in _ADAM_PARTS}
        state["generator"] = self._generator.get_state()
        return state

    def set_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes back to what `get_state` gave."""
        prefix = "network."
        self.network.load_state_dict(
            {name.removeprefix(prefix): it for name, it in state.items() if name.startswith(prefix)}
        )
        for name, parameter in self.network.named_parameters():
            self._optimiser.state[parameter] = {
                part: state[f"optimiser.{name}.{part}"].clone() for part in _ADAM_PARTS
            }
        self._generator.set_state(state["generator"])


_ADAM_PARTS = ("step", "exp_avg", "exp_avg_sq")


def _fresh_state(parameter: Tensor) -> dict[str, Tensor]:
    """Adam's before its first step."""
    zeros = torch.zeros_like(parameter)
    return {"step": torch.tensor(0.0), "exp_avg": zeros, "exp_avg_sq": zeros}


def _checked(name: str, real: Tensor | None, shape: tuple[int, int, int]) -> Tensor:
    if real is None or len(real) == 0:
        raise MessageError(
            f"discriminator {name}: expected pictures of {name} states; got none; give "
            "demonstrations that have some"
        )
    if real.dtype != torch.uint8 or tuple(real.shape[1:]) != tuple(shape):
        raise MessageError(
            f"discriminator {name}: expected pictures uint8 [n, {', '.join(map(str, shape))}]; got "
            f"{real.dtype} {list(real.shape)}; demonstrations and preset are of different tasks"
        )
    return real
