from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from actors.acting import UniformlyRandom
from actors.robot.planning import Obstacle
from broker_config.errors import PresetError
from deploy import task_check
from deploy.reach_check import check_reach, portion
from deploy.task_check import check_task
from deploy.task_commands import reach, task, watch
from deploy.watch import watch as write_episode


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
