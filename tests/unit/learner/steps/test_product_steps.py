"""The steps by matrix products against autograd, which defines what is correct."""

from __future__ import annotations

import copy
import math
import statistics
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from actors.networks import PreferenceNetwork, build_network
from broker_config.errors import PresetError
from broker_config.preset import OptimiserPreset, Preset
from broker_config.specs import Head, NetworkSpec
from deploy.presets import load_preset
from learner.memory import LocalMemory
from learner.steps import compute
from learner.steps.compute import Compute
from learner.steps.eager_steps import EagerSteps, GradientSteps, preference_loss
from learner.steps.optimiser import build_optimiser
from learner.steps.product_steps import ProductEvaluation, ProductSteps
from learner.trainer import Trainer

N_ACTIONS, N_SAMPLES = 7, 24
HEADS: tuple[Head, ...] = ("plain", "dueling-penalty", "dueling-exact", "dueling-mean")
SHAPES = ((84, 84, 1), (36, 36, 3), (47, 61, 3))
"""As in the source; the smallest; one where no stride divides anything."""
BATCH = torch.tensor([3, 0, 23, 11, 11])
LARGE_BATCH = torch.randint(N_SAMPLES, (40,), generator=torch.Generator().manual_seed(3))
"""More pictures than go through the convolutions at once."""
TARGETS = torch.randn(N_SAMPLES, generator=torch.Generator().manual_seed(1))


def filled_memory(shape: tuple[int, int, int]) -> LocalMemory:
    """A memory whose ring has wrapped."""
    generator = np.random.default_rng(0)
    memory = LocalMemory(N_SAMPLES, shape)
    for _ in range(5):
        length = 12
        memory.add(
            generator.integers(0, 256, (length + 1, *shape), np.uint8),
            generator.integers(0, N_ACTIONS, length).astype(np.int32),
            generator.normal(size=length).astype(np.float32),
            terminated=False,
        )
    return memory


def network_of(head: Head, shape: tuple[int, int, int], seed: int = 3) -> PreferenceNetwork:
    spec = NetworkSpec(shape, N_ACTIONS, head, 1.0)
    return build_network(spec, seed, starts_at_zero_value=True)


class Recording:
    """An optimiser that keeps the gradients, and changes nothing."""

    def __init__(self, network: PreferenceNetwork) -> None:
        self._network = network
        self.gradients: dict[str, Tensor] = {}

    def zero_grad(self) -> None:
        self._network.zero_grad()

    def step(self) -> None:
        for name, parameter in self._network.named_parameters():
            if parameter.grad is not None:
                assert parameter.grad.stride() == parameter.stride()
                self.gradients[name] = parameter.grad.clone()

    def step_rounded(self, parameter: Tensor, gradients: Tensor, rounded: Tensor) -> None:
        assert torch.equal(rounded, parameter.to(torch.bfloat16))
        (name,) = (name for name, each in self._network.named_parameters() if each is parameter)
        self.gradients[name] = gradients.to(torch.float32)
        rounded.fill_(torch.nan)  # whoever read it now would read the next step's


def gradients_by_products(
    network: PreferenceNetwork,
    memory: LocalMemory,
    batch: Tensor,
    targets: Tensor,
    factors: torch.dtype,
) -> tuple[dict[str, Tensor], float]:
    optimiser = Recording(network)
    steps = ProductSteps(network, optimiser, memory, factors)  # type: ignore[arg-type]
    loss = steps.run(batch.unsqueeze(0), targets)
    return optimiser.gradients, loss.item()


def gradients_by_autograd(
    network: PreferenceNetwork,
    memory: LocalMemory,
    batch: Tensor,
    targets: Tensor,
    *,
    autocast: bool = False,
) -> tuple[dict[str, Tensor], float]:
    """In float64, so that what is left is the error of the products alone; or by torch's bf16."""
    network = copy.deepcopy(network).to(torch.float32 if autocast else torch.float64)
    pictures = memory.ring[memory.ring_positions[batch]].to(torch.float32)
    if not autocast:
        convolve = network.convolutions[0].forward
        network.convolutions[0].forward = lambda x: convolve(x.double())
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        loss = preference_loss(
            network, pictures, memory.samples.actions[batch], targets[batch].double()
        )
    loss.backward()  # type: ignore[no-untyped-call]
    gradients = {name: part.grad for name, part in network.named_parameters()}
    return {name: each for name, each in gradients.items() if each is not None}, loss.item()


def relative_error(got: Tensor, expected: Tensor) -> float:
    return float((got - expected).norm() / expected.norm())


@pytest.mark.parametrize("batch", [BATCH, LARGE_BATCH], ids=["5 samples", "40 samples"])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("head", HEADS)
def test_gradients_are_those_of_autograd(
    head: Head, shape: tuple[int, int, int], batch: Tensor
) -> None:
    network, memory = network_of(head, shape), filled_memory(shape)
    expected, expected_loss = gradients_by_autograd(network, memory, batch, TARGETS)
    got, loss = gradients_by_products(network, memory, batch, TARGETS, torch.float32)
    assert loss == pytest.approx(expected_loss, rel=1e-5)
    assert got.keys() == expected.keys()
    for name, gradient in expected.items():
        error = relative_error(got[name], gradient)
        assert error < 4e-6, f"{name}: relative error {error:.2g}"


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("head", HEADS)
def test_bfloat16_rounds_hardly_worse_than_mixed_precision_of_torch(
    head: Head, shape: tuple[int, int, int]
) -> None:
    """Over all parameters, and of several networks: a unit at 0 may fall to either side."""
    memory, ratios = filled_memory(shape), []
    for seed in range(5):
        network = network_of(head, shape, seed)
        exact, _ = gradients_by_autograd(network, memory, LARGE_BATCH, TARGETS)
        by_torch, _ = gradients_by_autograd(network, memory, LARGE_BATCH, TARGETS, autocast=True)
        got, _ = gradients_by_products(network, memory, LARGE_BATCH, TARGETS, torch.bfloat16)
        joined, of_torch, expected = (
            torch.cat([gradients[name].flatten().double() for name in exact])
            for gradients in (got, by_torch, exact)
        )
        ratios.append(relative_error(joined, expected) / relative_error(of_torch, expected))
    assert statistics.median(ratios) < 1.5


@pytest.mark.parametrize(
    ("factors", "most_of_loss", "most_of_learned"),
    [(torch.bfloat16, 5e-2, 0.5), (torch.float32, 1e-5, 1e-4)],
)
@pytest.mark.parametrize("optimiser", ["adam", "rmsprop"])
def test_steps_follow_the_reference(
    optimiser: str, factors: torch.dtype, most_of_loss: float, most_of_learned: float
) -> None:
    """Many steps, with minibatches of two sizes: the same losses up to rounding."""
    preset = OptimiserPreset(optimiser, 2.5e-4, 1e-2)  # type: ignore[arg-type]
    memory = filled_memory((36, 36, 1))
    targets = torch.randn(N_SAMPLES, generator=torch.Generator().manual_seed(1))
    generator = torch.Generator().manual_seed(2)
    batches = [torch.randint(N_SAMPLES, (10, size), generator=generator) for size in (8, 5)]
    batches.append(batches[0])
    networks, losses = [], []
    for make in (EagerSteps, partial(ProductSteps, factors=factors)):
        network = network_of("dueling-exact", (36, 36, 1))
        steps: GradientSteps = make(network, build_optimiser(preset, network), memory)
        losses.append(torch.cat([steps.run(rows, targets) for rows in batches]))
        networks.append(network.state_dict())
    torch.testing.assert_close(losses[1], losses[0], rtol=most_of_loss, atol=1e-5)
    assert losses[0][-10:].mean() < losses[0][:10].mean()
    before = network_of("dueling-exact", (36, 36, 1)).state_dict()
    for name, weights in networks[0].items():
        error = relative_error(networks[1][name] - before[name], weights - before[name])
        assert error < most_of_learned, f"{name}: relative error of what was learned {error:.2g}"


@pytest.mark.parametrize("n_pictures", [1, 64, 100])
def test_preferences_are_those_of_the_network(n_pictures: int) -> None:
    network, memory = network_of("dueling-penalty", (47, 61, 3)), filled_memory((47, 61, 3))
    steps = steps_of(network, memory, torch.float32)
    evaluate = ProductEvaluation(network, torch.float32)
    pictures = some_pictures(n_pictures, (47, 61, 3))
    for _ in range(2):  # nothing of other pictures or weights is left
        with torch.no_grad():
            expected = network(pictures)
        torch.testing.assert_close(evaluate(pictures), expected, rtol=1e-4, atol=1e-5)
        steps.run(BATCH.unsqueeze(0), TARGETS)


@pytest.mark.parametrize("head", HEADS)
def test_preferences_round_hardly_worse_than_mixed_precision_of_torch(head: Head) -> None:
    network, memory = network_of(head, (84, 84, 1)), filled_memory((84, 84, 1))
    steps, pictures = steps_of(network, memory, torch.bfloat16), some_pictures(100, (84, 84, 1))
    evaluate = ProductEvaluation(network, torch.bfloat16)
    for _ in range(2):
        with torch.no_grad():
            exact = network(pictures)
            with torch.autocast("cpu", torch.bfloat16):
                by_torch = network(pictures)
        # Of the head, which torch rounds too, products are float32: the error may be much smaller.
        assert relative_error(evaluate(pictures), exact) < 1.5 * relative_error(by_torch, exact)
        steps.run(BATCH.unsqueeze(0), TARGETS)


@pytest.mark.parametrize("factors", [torch.float32, torch.bfloat16])
def test_there_is_nothing_to_learn_from_ones_own_preferences(factors: torch.dtype) -> None:
    """Teaching signals are rounded as what learns from them is."""
    network, memory = network_of("plain", (84, 84, 1)), filled_memory((84, 84, 1))
    rows = memory.ring[memory.ring_positions]
    own = ProductEvaluation(network, factors)(rows).gather(1, memory.samples.actions.unsqueeze(1))
    _, loss = gradients_by_products(network, memory, LARGE_BATCH, own.squeeze(1), factors)
    assert loss < 1e-10


def steps_of(network: PreferenceNetwork, memory: LocalMemory, factors: torch.dtype) -> ProductSteps:
    optimiser = build_optimiser(OptimiserPreset("adam", 1e-3, 1e-8), network)
    return ProductSteps(network, optimiser, memory, factors)


def some_pictures(n: int, shape: tuple[int, int, int]) -> Tensor:
    generator = torch.Generator().manual_seed(4)
    return torch.randint(256, (n, *shape), generator=generator, dtype=torch.uint8)


def trained(asked: Compute) -> Trainer:
    preset: Preset = load_preset("reaching-smoke", ["task.observation_shape=[36,36,1]"])
    trainer = Trainer(preset, asked)
    generator = np.random.default_rng(0)
    for _ in range(2):
        trainer.add(
            generator.integers(0, 256, (11, 36, 36, 1), np.uint8),
            generator.integers(0, preset.task.n_actions, 10).astype(np.int32),
            generator.normal(size=10).astype(np.float32),
            terminated=False,
        )
        trainer.update()
    return trainer


@pytest.mark.parametrize(
    ("path", "factors"), [("winograd", torch.float32), ("winograd-bf16", torch.bfloat16)]
)
def test_a_trainer_evaluates_as_it_makes_steps(path: str, factors: torch.dtype) -> None:
    trainer = trained(Compute(path=path))  # type: ignore[arg-type]
    pictures = trainer.memory.live_frames(0, trainer.memory.n_frames)
    expected = ProductEvaluation(trainer._network, factors)(pictures)
    assert torch.equal(trainer._evaluate_frames(), expected)


@pytest.mark.parametrize("factors", [torch.float32, torch.bfloat16])
def test_a_network_that_has_diverged_shows_it(factors: torch.dtype) -> None:
    network, memory = network_of("plain", (36, 36, 1)), filled_memory((36, 36, 1))
    with torch.no_grad():
        network.convolutions[0].get_parameter("weight").fill_(torch.nan)
    _, loss = gradients_by_products(network, memory, BATCH, TARGETS, factors)
    assert math.isnan(loss)
    assert ProductEvaluation(network, factors)(memory.ring[:3]).isnan().all()


@pytest.mark.parametrize("path", ["winograd", "winograd-bf16"])
def test_a_trainer_that_goes_back_makes_the_same_steps_again(path: str) -> None:
    trainer = trained(Compute(path=path))  # type: ignore[arg-type]
    state = trainer.get_state()
    trainer.update()
    first = trainer.weights_bytes()
    trainer.set_state(state)
    trainer.update()
    assert trainer.weights_bytes() == first


@pytest.mark.parametrize("path", ["winograd", "winograd-bf16"])
def test_a_path_repeats_itself_bit_for_bit(path: str) -> None:
    asked = Compute(path=path)  # type: ignore[arg-type]
    first, second = trained(asked), trained(asked)
    assert first.weights_bytes() == second.weights_bytes()
    assert first.weights_bytes() != trained(Compute(path="reference")).weights_bytes()


def test_a_path_goes_on_from_what_another_has_learned() -> None:
    state = trained(Compute(path="reference")).get_state()
    resumed = Trainer(
        load_preset("reaching-smoke", ["task.observation_shape=[36,36,1]"]),
        Compute(path="winograd"),
    )
    resumed.set_state(state)
    resumed.update()
    assert resumed.gradient_steps > state.counters["gradient_steps"]


@pytest.mark.parametrize(
    ("can_multiply", "expected"), [(True, "winograd-bf16"), (False, "winograd")]
)
def test_a_path_is_chosen_by_what_the_processor_can_do(
    monkeypatch: pytest.MonkeyPatch, can_multiply: bool, expected: str
) -> None:
    monkeypatch.setattr(compute, "multiplies_bfloat16", lambda: can_multiply)
    assert str(Compute()) == f"{expected} steps of revision 2 on cpu"
    assert Compute("cuda:1").chosen_path == "graphs"
    assert str(replace(Compute(), path="reference")) == "reference steps on cpu"


def test_what_the_processor_can_do_is_what_torch_knows_of_it() -> None:
    known = torch.cpu.get_capabilities()
    assert compute.multiplies_bfloat16() == bool(
        known.get("avx512_bf16", False) or known.get("amx_bf16", False)
    )


def test_paths_that_a_device_does_not_have_are_refused() -> None:
    with pytest.raises(PresetError, match="expected winograd or winograd-bf16 or reference on cpu"):
        Compute("cpu", "graphs")
    with pytest.raises(PresetError, match="expected cpu or cuda; got tpu"):
        Compute("tpu")
