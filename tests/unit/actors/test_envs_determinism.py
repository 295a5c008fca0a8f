"""XPBD episodes have the same bits in every process, and after a state was returned to."""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from actors.cloth.xpbd_engine import XpbdEngine
from actors.envs import ENV_IDS, ClothTaskEnv, make_env

CLOTH_IDS = [env_id for env_id in ENV_IDS if "Reaching" not in env_id]
COARSE_M = {"HandkerchiefFlip36": 0.05, "HandkerchiefFlip60": 0.05, "HandkerchiefFold": 0.03}
STEPS = 3
REPOSITORY = Path(__file__).parents[3]


def make(env_id: str) -> ClothTaskEnv:
    """With few vertices, and with everything random that a seed can draw."""
    spacing_m = COARSE_M.get(env_id.removeprefix("clothbus/").removesuffix("-v0"), 0.025)
    env = make_env(
        env_id,
        spacing_m=spacing_m,
        randomisation="sim2real",
        initial_state="creased",
        horizon=STEPS,
    ).unwrapped
    assert isinstance(env, ClothTaskEnv)
    return env


def played(env: ClothTaskEnv, random: np.random.Generator) -> Iterator[bytes]:
    """All that comes of random actions until the end: pictures, rewards, flags, vertices."""
    for _ in range(STEPS):
        picture, reward, _, truncated, info = env.step(int(random.integers(env.n_actions)))
        assert info["guard"] is None
        yield picture.tobytes()
        yield np.float64(reward).tobytes()
        yield f"{truncated} {info['success']}".encode()
        yield env.vertices_in_world().tobytes()
    assert truncated


def episode_digest(env_id: str) -> str:
    env = make(env_id)
    picture, _ = env.reset(seed=4)
    digest = hashlib.sha256(picture.tobytes() + env.vertices_in_world().tobytes())
    for part in played(env, np.random.default_rng(7)):
        digest.update(part)
    return digest.hexdigest()


_IN_ANOTHER_PROCESS = """
import json
from tests.unit.actors.test_envs_determinism import CLOTH_IDS, episode_digest
print(json.dumps({env_id: episode_digest(env_id) for env_id in CLOTH_IDS}))
"""


def test_whole_episodes_have_the_same_bits_in_another_process_and_folder(tmp_path: Path) -> None:
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", _IN_ANOTHER_PROCESS],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY), "PYTHONHASHSEED": hash_seed},
            stdout=subprocess.PIPE,
            text=True,
        )
        for folder, hash_seed in ((REPOSITORY, "1"), (tmp_path, "2"))
    ]
    first, second = (json.loads(process.communicate()[0]) for process in processes)
    assert [process.returncode for process in processes] == [0, 0]
    assert list(first) == CLOTH_IDS
    assert first == second
    assert len(set(first.values())) == len(CLOTH_IDS)


@pytest.mark.parametrize("env_id", CLOTH_IDS)
def test_an_engine_restored_in_the_middle_of_an_episode_goes_on_alike(env_id: str) -> None:
    def played_on(engine: XpbdEngine) -> list[np.ndarray]:
        """The vertices after each of the episode's gestures from there on."""
        seen = []
        for gesture in gestures:
            engine.perform(gesture)
            seen.append(engine.vertices_in_world())
        return seen

    env = make(env_id)
    env.reset(seed=4)
    engine = env._scene._engine
    assert isinstance(engine, XpbdEngine)
    random = np.random.default_rng(7)
    env.step(int(random.integers(env.n_actions)))
    state, gestures, expected = engine.save(), [], []
    for _ in range(STEPS):
        action = int(random.integers(env.n_actions))
        gestures.append(env.planned(action).gesture)
        engine.perform(gestures[-1])
        assert env._scene._see() is None
        expected.append(engine.vertices_in_world())
    assert (expected[-1] != state.positions_m).any()
    engine.restore(state)
    np.testing.assert_array_equal(played_on(engine), expected)
    other = XpbdEngine(engine.settings)
    other.restore(state)
    np.testing.assert_array_equal(played_on(other), expected)
