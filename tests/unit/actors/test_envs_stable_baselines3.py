"""Whoever trains with stable-baselines3 takes the tasks as they are."""

from typing import Any

import gymnasium
import pytest
import torch

import actors.envs  # noqa: F401 - registers the ids

stable_baselines3: Any = pytest.importorskip(
    "stable_baselines3", reason="stable-baselines3 is not installed: pip install clothbus[sb3]"
)

STEPS = 2000


@pytest.mark.timeout(600)  # most of a minute of processor time; a busy machine has little
def test_its_dqn_trains_on_a_task_without_adaptation() -> None:
    env = gymnasium.make("clothbus/HandkerchiefFlip36-v0", spacing_m=0.3 / 6)
    model = stable_baselines3.DQN(
        "CnnPolicy",
        env,
        buffer_size=STEPS,
        learning_starts=200,
        train_freq=50,
        target_update_interval=500,
        seed=0,
        device="cpu",
    )
    before = {name: array.clone() for name, array in model.q_net.state_dict().items()}
    model.learn(STEPS)
    assert model.num_timesteps == STEPS
    after = model.q_net.state_dict()
    assert all(torch.isfinite(array).all() for array in after.values())
    assert all((array != before[name]).any() for name, array in after.items())
    episodes = [episode["l"] for episode in model.ep_info_buffer]
    assert len(episodes) >= STEPS // 30
    assert set(episodes) <= set(range(1, 31))
    picture, _ = env.reset(seed=0)
    action, _ = model.predict(picture, deterministic=True)
    assert env.action_space.contains(int(action))
    env.close()
