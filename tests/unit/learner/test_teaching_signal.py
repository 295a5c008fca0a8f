import math

import numpy as np
import pytest
import torch
from torch import Tensor

from learner.teaching_signal import (
    MUNCHAUSEN_BOUND,
    bellman_error,
    bellman_target,
    double_q_value,
    dpn_teaching_signal,
    entropy,
    epsilon_greedy_entropy,
    epsilon_greedy_value,
    soft_value,
    softmax_policy,
)

ETAS = (0.01, 0.1, 1.0, 10.0)
NOT_ENDED = torch.tensor([False])


def test_soft_value_and_policy_by_hand() -> None:
    # exp(2 * P) is 1, 2 and 4: the sum is 7.
    preferences = torch.tensor([[0.0, math.log(2) / 2, math.log(4) / 2]])
    torch.testing.assert_close(soft_value(preferences, 2.0), torch.tensor([math.log(7) / 2]))
    expected = torch.tensor([[1 / 7, 2 / 7, 4 / 7]])
    torch.testing.assert_close(softmax_policy(preferences, 2.0), expected)
    by_hand = math.log(7) - (2 * math.log(2) + 4 * math.log(4)) / 7
    torch.testing.assert_close(entropy(preferences, 2.0), torch.tensor([by_hand]))


def test_a_large_inverse_temperature_gives_the_maximum() -> None:
    preferences = torch.tensor([[1.0, 3.0, -200.0]])
    assert soft_value(preferences, 1e4).item() == pytest.approx(3.0)


def test_equal_preferences_have_the_entropy_and_value_of_chance() -> None:
    preferences = torch.zeros(1, 25)
    assert soft_value(preferences, 0.01).item() == pytest.approx(math.log(25) / 0.01)
    assert entropy(preferences, 0.01).item() == pytest.approx(math.log(25))


def test_entropy_of_a_certain_policy_is_zero_not_nan() -> None:
    assert entropy(torch.tensor([[1e4, -1e4]]), 10.0).item() == 0.0


def signal(alpha: float, terminated: Tensor = NOT_ENDED) -> float:
    return dpn_teaching_signal(
        torch.tensor([2.0]),
        torch.tensor([3.0]),
        torch.tensor([-0.5]),
        torch.tensor([4.0]),
        terminated,
        alpha=alpha,
        gamma=0.9,
    ).item()


def test_teaching_signals_by_hand() -> None:
    assert signal(alpha=1.0) == pytest.approx(2.0 - 3.0 - 0.5 + 0.9 * 4.0)  # DPN, eq. 3.1
    assert signal(alpha=0.8) == pytest.approx(0.8 * (2.0 - 3.0) - 0.5 + 0.9 * 4.0)  # EDPN, 4.10
    dqn = bellman_target(torch.tensor([-0.5]), torch.tensor([4.0]), NOT_ENDED, 0.9)
    assert dqn.item() == pytest.approx(-0.5 + 0.9 * 4.0)  # DQN, eq. 2.12


def test_munchausen_is_edpn_but_for_the_bound() -> None:
    values = torch.tensor([3.0, 3.0])
    chosen = torch.tensor([2.7, -5.0])  # log pi / beta of -0.3 and of -8
    rewards, after = torch.tensor([-0.5, -0.5]), torch.tensor([4.0, 4.0])
    ended = torch.zeros(2, dtype=torch.bool)
    numbers = {"alpha": 0.9, "gamma": 0.9}
    munchausen = dpn_teaching_signal(
        chosen, values, rewards, after, ended, **numbers, least_log_policy=MUNCHAUSEN_BOUND
    )
    edpn = dpn_teaching_signal(chosen, values, rewards, after, ended, **numbers)
    assert munchausen[0] == edpn[0]
    assert munchausen[1].item() == pytest.approx(0.9 * -1.0 - 0.5 + 0.9 * 4.0)


def test_double_q_takes_the_targets_value_of_the_networks_choice() -> None:
    target = torch.tensor([[1.0, 9.0, 2.0], [5.0, 4.0, 3.0]])
    network = torch.tensor([[0.0, 1.0, 7.0], [2.0, 8.0, 1.0]])
    assert double_q_value(target, network).tolist() == [2.0, 4.0]


def test_a_termination_cuts_off_what_follows() -> None:
    assert signal(1.0, torch.tensor([True])) == pytest.approx(2.0 - 3.0 - 0.5)


def test_nothing_that_follows_a_termination_leaks_in() -> None:
    after = torch.tensor([float("inf")])
    target = bellman_target(torch.tensor([1.0]), after, torch.tensor([True]), 0.9)
    assert target.item() == 1.0


def test_sigma_zero_gives_dpn_bit_for_bit() -> None:
    generator = torch.Generator().manual_seed(0)
    chosen, values, rewards, after = (100 * torch.randn(4, 10_000, generator=generator)).unbind()
    ended = torch.zeros(10_000, dtype=torch.bool)
    eta, sigma = 0.7, 0.0
    alpha = 1.0 / (1.0 + sigma * eta)
    edpn = dpn_teaching_signal(chosen, values, rewards, after, ended, alpha=alpha, gamma=0.95)
    dpn = chosen - values + (rewards + 0.95 * after)
    assert torch.equal(edpn, dpn)


def test_value_and_entropy_of_epsilon_greedy_by_hand() -> None:
    preferences = torch.tensor([[1.0, 5.0, 0.0, 2.0]])
    assert epsilon_greedy_value(preferences, 0.25).item() == pytest.approx(0.75 * 5 + 0.25 * 2)
    p, q = 0.75 + 0.25 / 4, 0.25 / 4
    expected = -(p * math.log(p) + 3 * q * math.log(q))
    assert epsilon_greedy_entropy(0.25, 4).item() == pytest.approx(expected)
    assert epsilon_greedy_entropy(0.0, 4).item() == 0.0
    assert epsilon_greedy_entropy(1.0, 4).item() == pytest.approx(math.log(4))


def test_bellman_error_by_hand() -> None:
    error = bellman_error(torch.tensor([1.0, 3.0]), torch.tensor([2.0, 5.0]))
    assert error.absolute.item() == pytest.approx(1.5)
    assert error.relative.item() == pytest.approx(1.5)  # the values' standard deviation is 1
    assert math.isfinite(bellman_error(torch.ones(2), torch.zeros(2)).relative.item())


# The operator on a small Markov decision process ------------------------------------------------

N_STATES, N_ACTIONS, GAMMA = 5, 3, 0.9


def random_process() -> tuple[Tensor, Tensor]:
    generator = np.random.default_rng(4)
    transitions = generator.dirichlet(np.full(N_STATES, 0.3), (N_STATES, N_ACTIONS))
    rewards = generator.normal(size=(N_STATES, N_ACTIONS))
    return torch.tensor(transitions), torch.tensor(rewards)


def optimal_values(transitions: Tensor, rewards: Tensor) -> Tensor:
    values = torch.zeros(N_STATES, dtype=torch.float64)
    for _ in range(1000):
        values = (rewards + GAMMA * transitions @ values).amax(1)
    return values


def iterate_operator(
    transitions: Tensor, rewards: Tensor, eta: float, sigma: float, n: int
) -> Tensor:
    alpha, beta = 1 / (1 + sigma * eta), eta / (1 + sigma * eta)
    preferences = torch.zeros(N_STATES, N_ACTIONS, dtype=torch.float64)
    ended = torch.zeros(N_STATES * N_ACTIONS, dtype=torch.bool)
    for _ in range(n):
        values = soft_value(preferences, beta)
        preferences = dpn_teaching_signal(
            preferences.flatten(),
            values.repeat_interleave(N_ACTIONS),
            rewards.flatten(),
            (transitions @ values).flatten(),
            ended,
            alpha=alpha,
            gamma=GAMMA,
        ).view(N_STATES, N_ACTIONS)
    return preferences


@pytest.mark.parametrize("eta", ETAS)
def test_iterating_the_operator_reaches_the_optimal_policy(eta: float) -> None:
    transitions, rewards = random_process()
    best = optimal_values(transitions, rewards)
    # The policy's error falls with eta * n: the smaller eta, the more iterations.
    preferences = iterate_operator(transitions, rewards, eta, 0.0, n=round(200 + 60 / eta))
    policy = softmax_policy(preferences, eta)
    optimal_actions = (rewards + GAMMA * transitions @ best).argmax(1)
    assert torch.equal(policy.argmax(1), optimal_actions)
    own_values = torch.linalg.solve(
        torch.eye(N_STATES, dtype=torch.float64)
        - GAMMA * torch.einsum("sa,sat->st", policy, transitions),
        (policy * rewards).sum(1),
    )
    torch.testing.assert_close(own_values, best, atol=1e-3, rtol=0)
    torch.testing.assert_close(soft_value(preferences, eta), best, atol=0.1, rtol=0)


def test_causal_entropy_bounds_the_preferences_that_otherwise_drift() -> None:
    transitions, rewards = random_process()
    drifting = iterate_operator(transitions, rewards, 1.0, 0.0, n=2000)
    bounded = iterate_operator(transitions, rewards, 1.0, 0.05, n=2000)
    more = iterate_operator(transitions, rewards, 1.0, 0.05, n=4000)
    assert drifting.min() < -500
    torch.testing.assert_close(bounded, more)
