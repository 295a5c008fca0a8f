"""Discriminators of one moment: they score states, and learn nothing."""

from __future__ import annotations

from collections.abc import Mapping

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from broker_config.errors import DecodeError, MessageError
from broker_config.preset import Preset
from discriminator.networks import build_discriminator, logits_of
from discriminator.rewards import join_rewards
from discriminator.trainer import taking_part


class StoredDiscriminators:
    """What `Discriminators.weights_bytes` gave, ready to score states."""

    def __init__(self, preset: Preset, weights: bytes) -> None:
        """Reads a snapshot.

        Args:
            preset: Whose discriminators they were.
            weights: Safetensors, all networks' in one.

        Raises:
            MessageError: The preset has no [imitation] table.
            DecodeError: The bytes are no safetensors, or not the weights of these discriminators:
                a tensor is missing, unexpected, not finite, or of another shape or dtype.
        """
        if preset.imitation is None:
            raise MessageError(
                f"{preset.name}: expected an [imitation] table; got none; take the preset of the "
                "run that made the snapshot"
            )
        self._shape = preset.task.observation_shape
        self._preset = preset.imitation.discriminator
        self._networks = {
            name: build_discriminator(self._shape, 0, spectral_norm=self._preset.spectral_norm)
            for name in taking_part(preset.imitation)
        }
        self._load(_decoded(weights))

    @property
    def names(self) -> tuple[str, ...]:
        """Of those that take part."""
        return tuple(self._networks)

    def logits(self, states: Tensor) -> dict[str, Tensor]:
        """Of each discriminator, f32[n].

        Args:
            states: u8[n, H, W, C], at least one.

        Raises:
            MessageError: The states are none, or not pictures of the preset's task.
        """
        rule = f"uint8 [n, {', '.join(map(str, self._shape))}], n at least 1"
        fits = states.dtype == torch.uint8 and tuple(states.shape[1:]) == tuple(self._shape)
        if not fits or len(states) == 0:
            raise MessageError(
                f"states: expected {rule}; got {states.dtype} {list(states.shape)}; states and "
                "preset are of different tasks"
            )
        return {name: logits_of(network, states) for name, network in self._networks.items()}

    def rewards(self, states: Tensor) -> Tensor:
        """The reward of each transition into these states, f32[n]: see `Discriminators.rewards`.

        Args:
            states: u8[n, H, W, C]: all of D_G, where rewards are centred over it.

        Raises:
            MessageError: As for `logits`.
        """
        return join_rewards(list(self.logits(states).values()), self._preset)

    def _load(self, weights: Mapping[str, Tensor]) -> None:
        expected = {
            f"{name}.{part}": tensor
            for name, network in self._networks.items()
            for part, tensor in network.state_dict().items()
        }
        if missing := sorted(expected.keys() - weights.keys()):
            raise self._mismatch(f"tensor {missing[0]}", "none")
        if unexpected := sorted(weights.keys() - expected.keys()):
            raise self._mismatch("only the networks' own tensors", f"also {unexpected[0]}")
        for name, tensor in expected.items():
            got = weights[name]
            if got.shape != tensor.shape or got.dtype != tensor.dtype:
                raise self._mismatch(f"{name} {_described(tensor)}", _described(got))
            if not torch.isfinite(got).all():
                raise self._mismatch(f"{name} of finite numbers", "some that are not")
        with torch.no_grad():
            for name, tensor in expected.items():
                tensor.copy_(weights[name])

    def _mismatch(self, rule: str, got: str) -> DecodeError:
        return DecodeError(
            f"discriminators' weights: expected {rule} for {' and '.join(self._networks)} on "
            f"{list(self._shape)}; got {got}; snapshot and preset are of different runs"
        )


def _decoded(weights: bytes) -> dict[str, Tensor]:
    try:
        return dict(safetensors.torch.load(weights))
    except safetensors.SafetensorError as error:
        raise DecodeError(
            f"discriminators' weights: expected safetensors; got {len(weights)} bytes that are "
            f"none ({error}); ask for the snapshot again"
        ) from error


def _described(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
