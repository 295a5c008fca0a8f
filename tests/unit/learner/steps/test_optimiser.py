import pytest
import torch
from torch import nn

from broker_config.errors import StorageError
from broker_config.preset import OptimiserPreset
from learner.steps.optimiser import FusedAdam, build_optimiser, named_state, overwrite

RMSPROP = OptimiserPreset("rmsprop", 2.5e-3, 1e-2, 0.95)
ADAM = OptimiserPreset("adam", 2.5e-3, 1e-8)


def layer() -> nn.Linear:
    torch.manual_seed(0)
    return nn.Linear(4, 3)


def descend(
    network: nn.Linear, optimiser: FusedAdam | torch.optim.Optimizer, n_steps: int
) -> torch.Tensor:
    for step in range(n_steps):
        inputs = torch.randn(8, 4, generator=torch.Generator().manual_seed(step))
        optimiser.zero_grad()
        (network(inputs) ** 2).mean().backward()
        optimiser.step()
    return network.weight.detach().clone()


def test_rmsprop_is_the_old_keras_form() -> None:
    """theta -= rate * g / (sqrt(v) + epsilon) with v = 0.95 * v + 0.05 * g**2, by hand."""
    network = nn.Linear(1, 1, bias=False)
    nn.init.constant_(network.weight, 0.5)
    optimiser = build_optimiser(RMSPROP, network)
    theta, v = 0.5, 0.0
    for gradient in (0.3, -0.1, 2.0):
        network.weight.grad = torch.tensor([[gradient]])
        optimiser.step()
        v = 0.95 * v + 0.05 * gradient**2
        theta -= 2.5e-3 * gradient / (v**0.5 + 1e-2)
        assert network.weight.item() == pytest.approx(theta, rel=1e-6)


def test_rmsprop_equals_torch_s_own_over_many_steps() -> None:
    ours, theirs = layer(), layer()
    reference = torch.optim.RMSprop(theirs.parameters(), 2.5e-3, alpha=0.95, eps=1e-2)
    ours_after = descend(ours, build_optimiser(RMSPROP, ours), 300)
    theirs_after = descend(theirs, reference, 300)
    torch.testing.assert_close(ours_after, theirs_after, atol=1e-6, rtol=1e-5)


def test_adam_equals_torch_s_own() -> None:
    ours, theirs = layer(), layer()
    reference = torch.optim.Adam(theirs.parameters(), 2.5e-3, eps=1e-8, fused=True)
    ours_after = descend(ours, build_optimiser(ADAM, ours), 50)
    assert torch.equal(ours_after, descend(theirs, reference, 50))


@pytest.mark.parametrize("preset", [ADAM, RMSPROP])
def test_steps_by_rounded_gradients_are_those_of_the_same_widened(preset: OptimiserPreset) -> None:
    ours, theirs = nn.Linear(70, 30), nn.Linear(70, 30)
    theirs.load_state_dict(ours.state_dict())
    rounding, widening = build_optimiser(preset, ours), build_optimiser(preset, theirs)
    rounded = torch.empty_like(ours.weight, dtype=torch.bfloat16)
    generator = torch.Generator().manual_seed(1)
    for _ in range(50):
        gradients = torch.randn(30, 70, generator=generator).to(torch.bfloat16)
        rounding.step_rounded(ours.weight, gradients, rounded)
        theirs.weight.grad = gradients.to(torch.float32)
        widening.step()
        assert torch.equal(rounded, ours.weight.to(torch.bfloat16))
    torch.testing.assert_close(ours.weight, theirs.weight, rtol=1e-5, atol=1e-6)
    for part, state in rounding.state[ours.weight].items():
        torch.testing.assert_close(state, widening.state[theirs.weight][part], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("preset", [ADAM, RMSPROP])
def test_goes_on_bit_identically_from_its_saved_state(preset: OptimiserPreset) -> None:
    network = layer()
    optimiser = build_optimiser(preset, network)
    descend(network, optimiser, 5)
    saved = {name: part.clone() for name, part in named_state(optimiser, network)}
    weights = {name: part.clone() for name, part in network.state_dict().items()}
    expected = descend(network, optimiser, 5)

    other = nn.Linear(4, 3)
    other.load_state_dict(weights)
    resumed = build_optimiser(preset, other)
    addresses = [part.data_ptr() for _, part in named_state(resumed, other)]
    overwrite(dict(named_state(resumed, other)), saved, "optimiser")
    assert torch.equal(descend(other, resumed, 5), expected)
    assert [part.data_ptr() for _, part in named_state(resumed, other)] == addresses


def test_refuses_a_foreign_state_and_writes_nothing() -> None:
    tensors = {"a": torch.zeros(2), "b": torch.zeros(3)}
    with pytest.raises(StorageError, match="a difference in b"):
        overwrite(tensors, {"a": torch.ones(2)}, "optimiser")
    with pytest.raises(StorageError, match=r"expected b torch.float32 \[3\]; got .* \[4\]"):
        overwrite(tensors, {"a": torch.ones(2), "b": torch.ones(4)}, "optimiser")
    assert tensors["a"].sum() == 0
