import numpy as np
import pytest

from actors.demonstrate.scripted import imperfect_action, scripted_reach_action
from actors.envs import make_env


@pytest.mark.parametrize("n_joints", [2, 5, 25])
def test_the_scripted_reach_is_near_the_best_return(n_joints: int) -> None:
    env = make_env("clothbus/Reaching-v0", n_joints=n_joints)
    _, info = env.reset()
    total = 0.0
    for _ in range(30):
        _, reward, _, _, info = env.step(scripted_reach_action(info["joint_angles_rad"]))
        total += float(reward)
    assert total > -20.0  # doing nothing: -50.5; the best that beam search finds: about -18


def test_mistakes_come_at_their_rate() -> None:
    actions = [imperfect_action(7, 1000, 0.3, np.random.default_rng(k)) for k in range(2000)]
    assert np.mean(np.array(actions) != 7) == pytest.approx(0.3, abs=0.05)
    assert imperfect_action(7, 36, 0.0, np.random.default_rng(0)) == 7
    everything = {imperfect_action(7, 3, 1.0, np.random.default_rng(k)) for k in range(50)}
    assert everything == {0, 1, 2}


def test_a_rate_that_is_no_probability_is_refused() -> None:
    with pytest.raises(ValueError, match=r"mistake_rate: expected a probability .* got 1\.5"):
        imperfect_action(0, 36, 1.5, np.random.default_rng(0))
