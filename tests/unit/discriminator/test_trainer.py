"""Discriminators learn, repeat themselves, and go on where they were."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from broker_config.errors import MessageError, StorageError
from broker_config.preset import Preset
from deploy.presets import load_preset
from discriminator.networks import build_discriminator
from discriminator.trainer import Discriminators, Positives

torch.set_num_threads(1)
SHAPE = (36, 36, 3)


def preset_with(**changes: object) -> Preset:
    """Of imitation on small pictures, with some values of the discriminators replaced."""
    preset = load_preset("reaching-ch4-horizon30", ["task.observation_shape=[36,36,3]"])
    assert preset.imitation is not None
    own = {name: changes.pop(name) for name in ("discriminators",) if name in changes}
    discriminator = replace(preset.imitation.discriminator, minibatch_size=16, **changes)
    imitation = replace(preset.imitation, discriminator=discriminator, **own)
    return replace(preset, imitation=imitation)


def pictures(n: int, brightness: int, seed: int) -> Tensor:
    """Noise around a brightness."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randint(-30, 31, (n, *SHAPE), generator=generator)
    return (brightness + noise).clamp(0, 255).to(torch.uint8)


def real() -> dict[Positives, Tensor]:
    return {"expert": pictures(40, 150, 0), "target": pictures(5, 200, 1)}


GENERATED = pictures(100, 80, 2)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"spectral_norm": True, "learning_rate": 5e-3},
        {"gradient_penalty": 0.05},
        {"target_prior": 0.1},
        {"colour_jitter": 0.2, "normalise_each": True},
    ],
    ids=lambda changes: ",".join(changes) or "plain",
)
def test_what_looks_real_is_rewarded_more(changes: dict[str, object]) -> None:
    discriminators = Discriminators(preset_with(**changes), real())
    first = discriminators.update(GENERATED)
    for _ in range(5):
        last = discriminators.update(GENERATED)
    assert set(last) == {"expert", "target"}
    if "target_prior" not in changes:  # with it, what is unlabelled counts as false by default
        assert all(report.accuracy > 0.9 for report in last.values())
    assert all(last[name].loss < first[name].loss for name in last)
    states = torch.cat((pictures(20, 80, 3), pictures(20, 150, 4), pictures(20, 200, 5)))
    by_chance, by_expert, at_target = discriminators.rewards(states).view(3, 20).mean(1).tolist()
    assert by_chance == min(by_chance, by_expert, at_target)


@pytest.mark.parametrize("which", ["expert", "target"])
def test_one_discriminator_alone(which: Positives) -> None:
    discriminators = Discriminators(preset_with(discriminators=which), real())
    assert discriminators.names == (which,)
    assert set(discriminators.update(GENERATED)) == {which}
    alone = Discriminators(preset_with(discriminators=which), {which: real()[which]})
    alone.update(GENERATED)
    assert alone.weights_bytes() == discriminators.weights_bytes()
    # Each trains by itself: the other one changes nothing.
    both = Discriminators(preset_with(), real())
    both.update(GENERATED)
    assert torch.equal(both.logits(GENERATED)[which], alone.logits(GENERATED)[which])


def test_the_prior_of_targets_is_the_target_discriminators_alone() -> None:
    """What was demonstrated is no rare find among what the policy has reached."""
    plain, unlabelled = (
        Discriminators(preset_with(target_prior=prior), real()) for prior in (0.0, 0.3)
    )
    for each in (plain, unlabelled):
        each.update(GENERATED)
    with_prior, without = unlabelled.logits(GENERATED), plain.logits(GENERATED)
    assert torch.equal(with_prior["expert"], without["expert"])
    assert not torch.equal(with_prior["target"], without["target"])


def test_epochs_end_once_it_is_right_often_enough() -> None:
    eager = Discriminators(preset_with(most_accuracy=0.6), real())
    reports = [eager.update(GENERATED) for _ in range(4)]
    assert reports[-1]["expert"].epochs == 1
    stubborn = Discriminators(preset_with(most_accuracy=1.0), real())
    assert {report.epochs for report in stubborn.update(GENERATED).values()} == {10}


def test_the_same_calls_give_the_same_weights_whatever_is_random_elsewhere() -> None:
    first = Discriminators(preset_with(), real())
    first.update(GENERATED)
    torch.manual_seed(99)
    before = torch.random.get_rng_state()
    second = Discriminators(preset_with(), real())
    second.update(GENERATED)
    assert second.weights_bytes() == first.weights_bytes()
    assert torch.equal(torch.random.get_rng_state(), before)
    other = Discriminators(replace(preset_with(), seed=1), real())
    assert other.weights_bytes() != Discriminators(preset_with(), real()).weights_bytes()


@pytest.mark.parametrize("spectral_norm", [False, True])
def test_they_go_on_bit_identically_from_a_saved_state(spectral_norm: bool) -> None:
    preset = preset_with(spectral_norm=spectral_norm)
    discriminators = Discriminators(preset, real())
    fresh = discriminators.get_state()
    discriminators.update(GENERATED)
    state = discriminators.get_state()
    discriminators.update(GENERATED)
    resumed = Discriminators(replace(preset, seed=7), real())
    resumed.set_state(state)
    resumed.update(GENERATED)
    assert resumed.weights_bytes() == discriminators.weights_bytes()
    resumed.set_state(fresh)
    assert all(torch.equal(part, fresh[name]) for name, part in resumed.get_state().items())


def test_labels_do_not_depend_on_how_many_are_labelled_at_once() -> None:
    discriminators = Discriminators(preset_with(centre_rewards=False), real())
    states = pictures(300, 120, 6)
    whole = discriminators.rewards(states)
    parts = torch.cat([discriminators.rewards(part) for part in states.split(100)])
    torch.testing.assert_close(parts, whole)
    before = discriminators.weights_bytes()
    discriminators.rewards(states)
    assert discriminators.weights_bytes() == before


def test_spectral_norm_holds_each_layers_largest_singular_value_at_one() -> None:
    discriminators = Discriminators(preset_with(spectral_norm=True), real())
    discriminators.update(GENERATED)
    network = discriminators._each["expert"].network
    for layer in (*network.convolutions, network.hidden, network.output):
        largest = torch.linalg.matrix_norm(layer.weight.detach().flatten(1), ord=2).item()
        assert largest == pytest.approx(1.0, abs=0.3)  # by one power iteration a step


def test_what_is_no_state_of_the_task_is_refused() -> None:
    with pytest.raises(MessageError, match="target: expected pictures of target states; got none"):
        Discriminators(preset_with(), {"expert": real()["expert"]})
    wrong = {**real(), "expert": torch.zeros((3, 84, 84, 3), dtype=torch.uint8)}
    with pytest.raises(
        MessageError, match=r"expert: expected pictures uint8 \[n, 36, 36, 3\]; got"
    ):
        Discriminators(preset_with(), wrong)
    state = Discriminators(preset_with(discriminators="expert"), real()).get_state()
    with pytest.raises(StorageError, match="belongs to another preset"):
        Discriminators(preset_with(), real()).set_state(state)
    with pytest.raises(MessageError, match="at least 36x36 px"):
        build_discriminator((20, 20, 3), 0, spectral_norm=False)
