import subprocess
import sys

import numpy as np
import pytest
import torch

from actors.networks import build_network, weights_to_bytes
from actors.policy import Policy
from broker_config.errors import DecodeError, MessageError
from broker_config.specs import NetworkSpec

SPEC = NetworkSpec((36, 36, 1), 4, "plain", 2.0)
OBSERVATION = np.random.default_rng(0).integers(0, 256, (36, 36, 1), np.uint8)


def policy_with_preferences(preferences: list[float]) -> Policy:
    """A policy whose preferences are these, whatever it sees."""
    weights = build_network(SPEC, 0, starts_at_zero_value=False).state_dict()
    weights["action_output.weight"].zero_()
    weights["action_output.bias"].copy_(torch.tensor(preferences))
    return Policy(SPEC, weights)


def test_probabilities_are_the_softmax_of_beta_times_preferences() -> None:
    preferences = np.array([0.0, 1.0, -1.0, 0.5])
    expected = np.exp(2.0 * preferences) / np.exp(2.0 * preferences).sum()
    policy = policy_with_preferences(list(preferences))
    np.testing.assert_allclose(policy.probabilities(OBSERVATION), expected, rtol=1e-6)


def test_samples_follow_the_probabilities() -> None:
    policy = policy_with_preferences([0.0, 0.5, -0.5, 0.25])
    generator = np.random.default_rng(1)
    n = 1500
    counts = np.bincount([policy.sample(OBSERVATION, generator) for _ in range(n)], minlength=4)
    expected = n * policy.probabilities(OBSERVATION)
    chi_square = ((counts - expected) ** 2 / expected).sum()
    assert chi_square < 16.3  # 3 degrees of freedom, p = 0.001


def test_extreme_preferences_neither_overflow_nor_leave_the_table() -> None:
    policy = policy_with_preferences([1e4, -1e4, 0.0, 9.9e3])
    generator = np.random.default_rng(1)
    assert {policy.sample(OBSERVATION, generator) for _ in range(20)} == {0}


def test_greedy_takes_the_first_of_the_best() -> None:
    assert policy_with_preferences([0.0, 2.0, 2.0, 1.0]).greedy(OBSERVATION) == 1


def test_epsilon_greedy_explores_at_its_rate() -> None:
    policy = policy_with_preferences([0.0, 1.0, 0.0, 0.0])
    generator = np.random.default_rng(1)
    n = 1500
    chosen = [policy.epsilon_greedy(OBSERVATION, 0.4, generator) for _ in range(n)]
    counts = np.bincount(chosen, minlength=4)
    expected = n * np.array([0.1, 0.7, 0.1, 0.1])
    assert ((counts - expected) ** 2 / expected).sum() < 16.3
    assert policy.epsilon_greedy(OBSERVATION, 0.0, generator) == 1


def test_the_numbers_drawn_do_not_depend_on_what_is_seen() -> None:
    for epsilon in (0.0, 0.5, 1.0):
        generator = np.random.default_rng(7)
        policy_with_preferences([0.0, 1.0, 0.0, 0.0]).epsilon_greedy(
            OBSERVATION, epsilon, generator
        )
        after = generator.random()
        generator = np.random.default_rng(7)
        generator.random(), generator.integers(4)
        assert after == generator.random()


@pytest.mark.parametrize("epsilon", [-0.1, 1.1, float("nan")])
def test_refuses_an_epsilon_that_is_no_probability(epsilon: float) -> None:
    policy = policy_with_preferences([0.0] * 4)
    with pytest.raises(MessageError, match="expected a probability"):
        policy.epsilon_greedy(OBSERVATION, epsilon, np.random.default_rng(0))


def test_refuses_another_observation() -> None:
    policy = policy_with_preferences([0.0] * 4)
    with pytest.raises(MessageError, match=r"expected uint8 \[36, 36, 1\]; got float32"):
        policy.greedy(OBSERVATION.astype(np.float32))
    with pytest.raises(MessageError, match=r"got uint8 \[36, 36\]"):
        policy.greedy(OBSERVATION[..., 0])


def test_accepts_a_read_only_observation() -> None:
    received = np.frombuffer(OBSERVATION.tobytes(), np.uint8).reshape(36, 36, 1)
    assert not received.flags.writeable
    assert 0 <= policy_with_preferences([0.0] * 4).greedy(received) < 4


def test_refuses_to_act_on_a_diverged_network() -> None:
    policy = policy_with_preferences([0.0, float("nan"), 0.0, 0.0])
    with pytest.raises(MessageError, match="the learner diverged"):
        policy.greedy(OBSERVATION)


def test_refuses_foreign_weights() -> None:
    with pytest.raises(DecodeError, match="weights"):
        Policy(SPEC, {})


def test_later_training_does_not_change_the_policy() -> None:
    network = build_network(SPEC, 0, starts_at_zero_value=True)
    policy = Policy(SPEC, network.state_dict())
    before = policy.preferences(OBSERVATION)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
    np.testing.assert_array_equal(policy.preferences(OBSERVATION), before)


ACTS_ELSEWHERE = """
import sys
import numpy as np, torch
from actors.policy import Policy
from broker_config.specs import NetworkSpec
torch.set_num_threads(1)
policy = Policy.from_bytes(NetworkSpec((36, 36, 1), 4, "plain", 2.0), sys.stdin.buffer.read())
observation = np.random.default_rng(0).integers(0, 256, (36, 36, 1), np.uint8)
generator = np.random.default_rng(3)
print([policy.sample(observation, generator) for _ in range(40)])
print(policy.preferences(observation).tobytes().hex())
"""


def test_acts_the_same_in_another_process() -> None:
    data = weights_to_bytes(build_network(SPEC, 9, starts_at_zero_value=True).state_dict())
    there = subprocess.run(
        [sys.executable, "-c", ACTS_ELSEWHERE], input=data, capture_output=True, check=True
    )
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        policy, generator = Policy.from_bytes(SPEC, data), np.random.default_rng(3)
        actions = [policy.sample(OBSERVATION, generator) for _ in range(40)]
        preferences = policy.preferences(OBSERVATION).tobytes().hex()
    finally:
        torch.set_num_threads(n_threads)
    assert there.stdout.decode().splitlines() == [str(actions), preferences]
