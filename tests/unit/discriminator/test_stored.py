"""Discriminators of a snapshot score states as those did that it was taken of."""

from __future__ import annotations

import pytest
import safetensors.torch
import torch

from broker_config.errors import DecodeError, MessageError
from broker_config.preset import Preset
from deploy.presets import load_preset
from discriminator.stored import StoredDiscriminators
from discriminator.trainer import Discriminators

torch.set_num_threads(1)
SHAPE = (36, 36, 3)


def preset_with(*overrides: str) -> Preset:
    settings = ["task.observation_shape=[36,36,3]", "imitation.discriminator.minibatch_size=8"]
    return load_preset("reaching-ch4-horizon30", [*settings, *overrides])


def pictures(n: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (n, *SHAPE), generator=generator, dtype=torch.uint8)


def trained(preset: Preset) -> Discriminators:
    discriminators = Discriminators(preset, {"expert": pictures(20, 0), "target": pictures(4, 1)})
    discriminators.update(pictures(30, 2))
    return discriminators


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("imitation.discriminator.spectral_norm=true",),
        ("imitation.discriminators=target", "imitation.discriminator.normalise_each=true"),
    ],
    ids=["plain", "spectral norm", "one alone"],
)
def test_it_scores_as_those_did(overrides: tuple[str, ...]) -> None:
    preset = preset_with(*overrides)
    discriminators = trained(preset)
    weights, states = discriminators.weights_bytes(), pictures(300, 3)
    snapshot = StoredDiscriminators(preset, weights)
    discriminators.update(pictures(30, 4))  # what is trained on does not change the snapshot
    before = Discriminators(preset, {"expert": pictures(1, 0), "target": pictures(1, 1)})
    assert not torch.equal(snapshot.rewards(states), before.rewards(states))
    again = trained(preset)
    assert snapshot.names == again.names
    assert torch.equal(snapshot.rewards(states), again.rewards(states))
    for name, logits in snapshot.logits(states).items():
        assert torch.equal(logits, again.logits(states)[name])


def changed(weights: bytes, name: str, tensor: torch.Tensor | None) -> bytes:
    tensors = dict(safetensors.torch.load(weights))
    tensors.pop(name, None)
    return safetensors.torch.save(tensors if tensor is None else {**tensors, name: tensor})


def test_refuses_weights_of_other_discriminators() -> None:
    preset = preset_with()
    weights = trained(preset).weights_bytes()
    bias = "expert.output.bias"
    for data, message in (
        (b"no weights", "expected safetensors; got 10 bytes that are none"),
        (weights[:-1], "expected safetensors"),
        (changed(weights, bias, None), f"tensor {bias} for expert and target .*; got none"),
        (changed(weights, "expert.more", torch.zeros(1)), r"got also expert\.more"),
        (changed(weights, bias, torch.zeros(2)), r"float32 \[1\] .*; got float32 \[2\]"),
        (changed(weights, bias, torch.zeros(1).double()), "got float64"),
        (changed(weights, bias, torch.tensor([torch.nan])), "finite numbers.*; got some that"),
    ):
        with pytest.raises(DecodeError, match=message):
            StoredDiscriminators(preset, data)
    with pytest.raises(DecodeError, match=r"also target\.convolutions.* different runs"):
        StoredDiscriminators(preset_with("imitation.discriminators=expert"), weights)
    with pytest.raises(DecodeError, match=r"expected tensor .*parametrizations"):
        StoredDiscriminators(preset_with("imitation.discriminator.spectral_norm=true"), weights)
    with pytest.raises(MessageError, match=r"expected an \[imitation\] table; got none"):
        StoredDiscriminators(load_preset("reaching-smoke"), weights)


def test_refuses_states_of_another_task() -> None:
    preset = preset_with()
    snapshot = StoredDiscriminators(preset, trained(preset).weights_bytes())
    for states, got in (
        (torch.zeros((2, 84, 84, 3), dtype=torch.uint8), r"uint8 \[2, 84, 84, 3\]"),
        (torch.zeros((2, *SHAPE)), "float32"),
        (pictures(0, 0), r"\[0, 36, 36, 3\]"),
    ):
        with pytest.raises(MessageError, match=rf"expected uint8 \[n, 36, 36, 3\].*got .*{got}"):
            snapshot.logits(states)
