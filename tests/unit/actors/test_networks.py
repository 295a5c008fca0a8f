import dataclasses
import math

import pytest
import torch
from torch import Tensor

from actors.networks import (
    _join,
    build_network,
    check_weights,
    weights_from_bytes,
    weights_to_bytes,
)
from broker_config.errors import DecodeError, MessageError
from broker_config.specs import Head, NetworkSpec

HEADS: tuple[Head, ...] = ("plain", "dueling-penalty", "dueling-exact", "dueling-mean")


def spec_of(head: Head = "plain", beta: float = 1.0, shape=(36, 36, 1), n_actions=4) -> NetworkSpec:
    return NetworkSpec(shape, n_actions, head, beta)


def pictures(spec: NetworkSpec, n: int = 3) -> Tensor:
    generator = torch.Generator().manual_seed(5)
    return torch.randint(0, 256, (n, *spec.observation_shape), generator=generator).to(torch.uint8)


def equal(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("shape", [(84, 84, 1), (84, 84, 3), (36, 60, 3)])
def test_gives_one_finite_number_for_each_action(head: Head, shape: tuple[int, int, int]) -> None:
    spec = spec_of(head, shape=shape, n_actions=7)
    outputs = build_network(spec, 0, starts_at_zero_value=True)(pictures(spec))
    assert outputs.shape == (3, 7)
    assert outputs.dtype == torch.float32
    assert torch.isfinite(outputs).all()


def test_layers_are_those_of_the_nature_network() -> None:
    network = build_network(spec_of(shape=(84, 84, 1)), 0, starts_at_zero_value=False)
    shapes = {name: list(tensor.shape) for name, tensor in network.state_dict().items()}
    assert shapes == {
        "convolutions.0.weight": [32, 1, 8, 8],
        "convolutions.0.bias": [32],
        "convolutions.1.weight": [64, 32, 4, 4],
        "convolutions.1.bias": [64],
        "convolutions.2.weight": [64, 64, 3, 3],
        "convolutions.2.bias": [64],
        "action_hidden.weight": [512, 3136],
        "action_hidden.bias": [512],
        "action_output.weight": [4, 512],
        "action_output.bias": [4],
    }


def test_refuses_a_picture_that_is_too_small() -> None:
    with pytest.raises(MessageError, match=r"at least 36x36 px.*\[35, 84, 1\]"):
        build_network(spec_of(shape=(35, 84, 1)), 0, starts_at_zero_value=True)


def test_weights_depend_on_the_seed_alone() -> None:
    spec = spec_of("dueling-exact")
    torch.manual_seed(1)
    first = build_network(spec, 3, starts_at_zero_value=True).state_dict()
    state = torch.random.get_rng_state()
    torch.manual_seed(2)
    again = build_network(spec, 3, starts_at_zero_value=True).state_dict()
    other = build_network(spec, 4, starts_at_zero_value=True).state_dict()
    assert equal(first, again)
    assert not equal(first, other)
    torch.manual_seed(1)
    assert torch.equal(torch.random.get_rng_state(), state)


def test_weights_are_uniform_in_the_documented_range() -> None:
    network = build_network(spec_of(shape=(84, 84, 1)), 0, starts_at_zero_value=False)
    weights = network.action_hidden.weight
    bound = 1 / math.sqrt(3136)
    assert weights.abs().max() <= bound
    assert weights.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.01)


@pytest.mark.parametrize("head", ["plain", "dueling-penalty", "dueling-exact"])
@pytest.mark.parametrize("beta", [0.01, 1.0, 20.0])
def test_the_soft_value_starts_at_zero_value_stream_aside(head: Head, beta: float) -> None:
    spec = spec_of(head, beta, n_actions=25)
    outputs = build_network(spec, 0, starts_at_zero_value=True)(pictures(spec))
    values = torch.logsumexp(beta * outputs, 1) / beta
    assert values.abs().max() < 0.5  # log(25) / beta would be 322, 3.2 and 0.16


@pytest.mark.parametrize("head", ["plain", "dueling-penalty"])
def test_only_the_output_bias_differs_where_the_value_starts_at_zero(head: Head) -> None:
    spec = spec_of(head, beta=0.5)
    literal = build_network(spec, 0, starts_at_zero_value=False).state_dict()
    centred = build_network(spec, 0, starts_at_zero_value=True).state_dict()
    offset = literal["action_output.bias"] - centred["action_output.bias"]
    torch.testing.assert_close(offset, torch.full((4,), math.log(4) / 0.5))
    del literal["action_output.bias"], centred["action_output.bias"]
    assert equal(literal, centred)


@pytest.mark.parametrize("beta", [0.01, 1.0, 20.0])
def test_the_exact_head_has_its_value_stream_as_soft_value(beta: float) -> None:
    values, outputs = torch.randn(5, 1), 3 * torch.randn(5, 4)
    joined = _join(spec_of("dueling-exact", beta), values, outputs)
    soft_values = torch.logsumexp(beta * joined, 1) / beta
    torch.testing.assert_close(soft_values, values[:, 0], atol=2e-5 / min(beta, 1), rtol=1e-5)
    torch.testing.assert_close(
        torch.softmax(beta * joined, 1), torch.softmax(beta * outputs, 1), atol=1e-5, rtol=1e-4
    )


def test_the_penalty_head_equals_equation_3_5() -> None:
    # beta 2, V = 1, A = (0, 0.5): the sum is 1 + e, so P = A + 1 - e / 2.
    joined = _join(
        spec_of("dueling-penalty", 2.0, n_actions=2), torch.ones(1, 1), torch.tensor([[0.0, 0.5]])
    )
    torch.testing.assert_close(joined, torch.tensor([[1 - math.e / 2, 1.5 - math.e / 2]]))


def test_the_mean_head_equals_reference_24() -> None:
    joined = _join(spec_of("dueling-mean"), torch.ones(1, 1), torch.tensor([[1.0, 2.0, 3.0, 6.0]]))
    torch.testing.assert_close(joined, torch.tensor([[-1.0, 0.0, 1.0, 4.0]]))


@pytest.mark.parametrize("head", HEADS)
def test_huge_outputs_stay_finite_and_keep_a_gradient(head: Head) -> None:
    outputs = torch.tensor([[500.0, 100.0, 0.0, -500.0]], requires_grad=True)
    values = torch.zeros(1, 1, requires_grad=True)
    joined = _join(spec_of(head, beta=20.0), values, outputs)
    (joined**2).mean().backward()
    assert outputs.grad is not None
    assert torch.isfinite(joined).all()
    assert torch.isfinite(outputs.grad).all()
    assert outputs.grad[0, 0] != 0


@pytest.mark.parametrize("head", HEADS)
def test_weights_survive_the_bus(head: Head) -> None:
    spec = spec_of(head)
    weights = build_network(spec, 0, starts_at_zero_value=True).state_dict()
    data = weights_to_bytes(weights)
    assert equal(weights_from_bytes(data, spec), weights)
    assert weights_to_bytes(weights_from_bytes(data, spec)) == data


def test_refuses_bytes_that_are_no_safetensors() -> None:
    with pytest.raises(DecodeError, match="got 7 bytes that are none"):
        weights_from_bytes(b"garbage", spec_of())


def test_refuses_truncated_bytes() -> None:
    data = weights_to_bytes(build_network(spec_of(), 0, starts_at_zero_value=True).state_dict())
    with pytest.raises(DecodeError, match="expected safetensors"):
        weights_from_bytes(data[:-1], spec_of())


def test_refuses_weights_of_another_network() -> None:
    spec = spec_of()
    weights = build_network(spec, 0, starts_at_zero_value=True).state_dict()
    more_actions = dataclasses.replace(spec, n_actions=5)
    with pytest.raises(DecodeError, match=r"action_output.weight float32 \[5, 512\].*\[4, 512\]"):
        check_weights(weights, more_actions)
    with pytest.raises(DecodeError, match=r"expected tensor value_hidden.bias .*got none"):
        check_weights(weights, dataclasses.replace(spec, head="dueling-exact"))
    with pytest.raises(DecodeError, match="got also extra"):
        check_weights({**weights, "extra": torch.zeros(1)}, spec)
    halved = {name: tensor.to(torch.float16) for name, tensor in weights.items()}
    with pytest.raises(DecodeError, match="got float16"):
        check_weights(halved, spec)
