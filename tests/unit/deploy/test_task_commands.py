from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from actors.acting import UniformlyRandom
from actors.envs import make_env
from actors.envs.handkerchief import HandkerchiefFlipEnv
from actors.envs.stored_states import GRID_M, read_stored_states
from actors.robot.planning import Obstacle
from broker_config.errors import PresetError, StorageError
from deploy.commands.tasks import reach, states, task, watch
from deploy.tasks import make_states, task_check
from deploy.tasks.reach_check import check_reach, portion
from deploy.tasks.task_check import check_task
from deploy.tasks.watch import watch as write_episode


def test_a_good_task_s_expert_succeeds_and_chance_does_not() -> None:
    check = check_task("clothbus/TrousersFold-v0", {"start_turn_rad": 0.1}, episodes=4, jobs=1)
    assert check.holds
    assert check.rate("expert") == 1.0
    assert [len(check.episodes[player]) for player in ("expert", "chance")] == [4, 4]
    assert check.episodes["expert"][0].measures["iou"] > 0.8
    assert check.episodes["expert"][0].steps_to_success == 2


def test_two_jobs_play_what_one_plays() -> None:
    options = {"n_joints": 2, "horizon": 3}
    one = check_task("clothbus/Reaching-v0", options, episodes=3, jobs=1)
    two = check_task("clothbus/Reaching-v0", options, episodes=3, jobs=2)
    returns = [sorted(it.return_ for it in check.episodes["chance"]) for check in (one, two)]
    assert returns[0] == returns[1]


def test_a_task_that_its_expert_fails_is_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        task_check, "scripted_demonstrator", lambda _, n_actions, **__: UniformlyRandom(n_actions)
    )
    with pytest.raises(SystemExit) as end:
        task("Reaching", episodes=2, options=("n_joints=2", "horizon=3"))
    assert end.value.code == 1
    assert "success at the end" in capsys.readouterr().out


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_an_episode_becomes_a_moving_picture(suffix: str, tmp_path: Path) -> None:
    output = tmp_path / "new" / f"fold.{suffix}"
    watch("HandkerchiefFold", output, options=("render_px=64",))
    assert output.stat().st_size > 1000
    if suffix == "gif":
        with Image.open(output) as picture:
            assert (picture.n_frames, picture.size) == (5, (64, 64))  # type: ignore[attr-defined]
            first = np.asarray(picture.convert("RGB"))
            picture.seek(4)
            assert (np.asarray(picture.convert("RGB")) != first).any()


def test_a_robot_s_episode_shows_its_arms_as_fast_as_they_move(tmp_path: Path) -> None:
    output = tmp_path / "fold.gif"
    episode = write_episode(
        "clothbus/HandkerchiefFold-v0", "scripted", {"robot": True, "render_px": 64}, 0, output
    )
    assert (episode.n_actions, episode.frame_secs) == (2, 0.2)
    assert len(episode.frames) > 50
    assert output.stat().st_size > 10_000


def test_reach_counts_every_action_and_the_script_s(capsys: pytest.CaptureFixture[str]) -> None:
    options = {"robot_stance": "front"}
    check = check_reach("clothbus/HandkerchiefFold-v0", options, episodes=2)
    assert check.all_actions.total() == 2 * 2 * 3
    assert check.scripted.total() == 2 * 2
    assert 0.0 < portion(check.all_actions, None) < 1.0
    assert check.all_actions[Obstacle.SELF_COLLISION] > 0
    reach("HandkerchiefFold", episodes=1)
    assert "reachable" in capsys.readouterr().out
    with pytest.raises(PresetError, match="expected a task with cloth for the robot"):
        reach("Reaching")
    with pytest.raises(PresetError, match="--episodes: expected at least 1; got 0"):
        reach("ShirtFold", episodes=0)
    with pytest.raises(PresetError, match="robot_stance: expected one of"):
        reach("ShirtFold", options=("robot_stance=roof",))


def test_what_cannot_be_watched_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PresetError, match=r"output: expected a file that ends in \.gif or \.mp4"):
        watch("ShirtFold", tmp_path / "fold.avi")
    with pytest.raises(PresetError, match="environment id: expected one of"):
        watch("SockFold", tmp_path / "fold.gif")
    with pytest.raises(PresetError, match="expected name=value; got no such pair"):
        watch("ShirtFold", tmp_path / "fold.gif", options=("hard",))
    with pytest.raises(PresetError, match="--jobs: expected at least 1; got 0"):
        task("ShirtFold", jobs=0)


# Initial states -------------------------------------------------------------------------------

COARSE = "spacing_m=0.05"


def test_states_are_made_from_their_seeds_and_stored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, again = tmp_path / "new" / "states.npz", tmp_path / "again.npz"
    for path in (output, again):
        states("HandkerchiefFlip60", path, ("flat", "folded_over"), seeds=2, options=(COARSE,))
    assert output.read_bytes() == again.read_bytes()
    assert "4 states of handkerchief" in " ".join(capsys.readouterr().out.split())
    stored = read_stored_states(str(output))
    assert stored.names == ("flat", "flat", "folded_over", "folded_over")
    assert stored.seeds.tolist() == [0, 1, 0, 1]
    env = make_env(stored.task, spacing_m=0.05).unwrapped
    assert isinstance(env, HandkerchiefFlipEnv)
    env.reset(seed=1, options={"initial_state": "folded_over"})
    assert np.abs(env.vertices_in_world() - stored.vertices_m[3]).max() <= GRID_M / 2


def test_a_seed_that_begins_with_the_task_solved_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reset(self: HandkerchiefFlipEnv, *, seed: int, options: dict[str, str]) -> object:
        picture, info = really_reset(self, seed=seed, options=options)
        return picture, info | {"success": seed in solved}

    really_reset, solved = HandkerchiefFlipEnv.reset, {0, 2, 3}
    monkeypatch.setattr(HandkerchiefFlipEnv, "reset", reset)
    states("HandkerchiefFlip36", tmp_path / "some.npz", ("flat",), seeds=2, options=(COARSE,))
    assert read_stored_states(str(tmp_path / "some.npz")).seeds.tolist() == [1, 4]
    monkeypatch.setattr(make_states, "MOST_SEEDS", 2)
    with pytest.raises(StorageError, match="expected 2 at which the task is unsolved; got 1 of 4"):
        states("HandkerchiefFlip36", tmp_path / "few.npz", ("flat",), seeds=2, options=(COARSE,))
    assert not (tmp_path / "few.npz").exists()


@pytest.mark.parametrize(
    ("env_id", "names", "options", "complaint"),
    [
        ("Reaching", ("flat",), (), "expected a task with cloth; got one without"),
        ("HandkerchiefFlip36", ("wet",), (COARSE,), "initial_state: expected one of .*; got 'wet'"),
        ("HandkerchiefFlip36", ("flat",), ('randomisation="sim2real"',), "garment's size alone"),
        ("HandkerchiefFlip36", ("flat",), ("spacing=1.0",), "expected some of the arguments"),
    ],
)
def test_states_that_cannot_be_made_are_refused(
    env_id: str, names: tuple[str, ...], options: tuple[str, ...], complaint: str, tmp_path: Path
) -> None:
    with pytest.raises(PresetError, match=complaint):
        states(env_id, tmp_path / "states.npz", names, seeds=1, options=options)
    with pytest.raises(PresetError, match="--seeds: expected at least 1; got 0"):
        states(env_id, tmp_path / "states.npz", names, seeds=0)
    with pytest.raises(PresetError, match=r"output: expected a file that ends in \.npz"):
        states("HandkerchiefFlip36", tmp_path / "states", ("flat",), seeds=1, options=(COARSE,))
