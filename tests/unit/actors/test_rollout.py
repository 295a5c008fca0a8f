"""Rollouts: an episode is a function of its ticket and its policy."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from actors.acting import EpsilonGreedy, Greedy, Sampled, UniformlyRandom, collecting_policy
from actors.envs import make_env
from actors.policy import Policy
from actors.rollout import Start, collect, rollout
from actors.step_log import StepLog, observation_digest
from broker_config.messages import Ticket, TrajectoryId
from deploy.presets import load_preset
from learner.trainer import Trainer

PRESET = load_preset("reaching-smoke")
ID = TrajectoryId("a", "life", 0)


def ticket(seed: int = 5, steps: int = 10) -> Ticket:
    return Ticket(0, 0, 0, seed, 0, steps, 0.3)


def network_policy() -> Policy:
    return Policy.from_bytes(PRESET.network, Trainer(PRESET).weights_bytes())


def test_the_same_ticket_gives_the_same_episode_whatever_was_played_before() -> None:
    env = make_env("clothbus/Reaching-v0", n_joints=2, horizon=10)
    for policy in (Sampled(network_policy()), EpsilonGreedy(network_policy()), UniformlyRandom(10)):
        first = collect(env, policy, ticket(), ID)
        collect(env, policy, ticket(seed=6), ID)
        again = collect(env, policy, ticket(), ID)
        assert np.array_equal(first.actions, again.actions)
        assert np.array_equal(first.observations, again.observations)
        assert first.observations.shape == (11, 84, 84, 1)
        assert (first.truncated, first.terminated) == (True, False)


def test_other_seeds_give_other_episodes_except_to_the_greedy() -> None:
    env = make_env("clothbus/Reaching-v0", n_joints=2, horizon=10)
    sampled, greedy = Sampled(network_policy()), Greedy(network_policy())
    by_seed = {tuple(collect(env, sampled, ticket(seed), ID).actions) for seed in range(5)}
    assert len(by_seed) == 5
    by_seed = {tuple(collect(env, greedy, ticket(seed), ID).actions) for seed in range(5)}
    assert len(by_seed) == 1


def test_a_ticket_for_the_rest_of_an_episode_plays_only_that() -> None:
    env = make_env("clothbus/Reaching-v0", n_joints=2, horizon=10)
    assert collect(env, UniformlyRandom(10), ticket(steps=4), ID).steps == 4


def test_dqn_collects_epsilon_greedily_and_the_dpn_family_by_its_softmax() -> None:
    dqn = load_preset("reaching-smoke", ["algorithm.method=dqn"])
    assert isinstance(collecting_policy(dqn.algorithm, network_policy()), EpsilonGreedy)
    assert isinstance(collecting_policy(PRESET.algorithm, network_policy()), Sampled)


def test_the_step_log_has_each_step_before_the_actor_does(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "steps.jsonl"
    env = StepLog(make_env("clothbus/Reaching-v0", n_joints=2, horizon=10), path, "life")
    for count, event in enumerate(rollout(env, UniformlyRandom(10), ticket())):
        lines = path.read_text().splitlines()
        assert len(lines) == count
        if not isinstance(event, Start):
            last = json.loads(lines[-1])
            assert last["observation"] == observation_digest(event.observation)
            assert (last["incarnation"], last["step"]) == ("life", count - 1)
    env.close()
