"""Demonstrations: episode k is a function of ticket k, whoever is killed meanwhile."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rich.console import Console

from actors.acting import EpsilonGreedy, Sampled
from actors.policy import Policy
from actors.rollout import collect
from actors.task import make_task_env
from broker_config.codec import encode
from broker_config.errors import AlreadyOwned, PresetError, StorageError
from broker_config.messages import DemonstrationsBegun, RunStarted, Trajectory, TrajectoryId, View
from broker_config.recording.check import RecordingCheck
from broker_config.recording.recording import Recording, iter_recording
from broker_config.version import VERSION
from deploy.demonstrations import making
from deploy.demonstrations.demonstrators import (
    by_chance,
    by_policy,
    by_script,
    by_script_of_quality,
)
from deploy.demonstrations.folder import DemonstrationFolder
from deploy.demonstrations.making import make_demonstrations
from deploy.presets import load_preset
from deploy.reproduce.catalogue import find
from deploy.reproduce.demonstrations import demonstrations_of
from deploy.run_folder import RunFolder, prepare_run_folder
from deploy.running.run import RunOptions
from deploy.running.run_in_process import run_in_process
from learner.recorded import Demonstrations, read_demonstrations
from learner.tickets import derive_seed

PRESET = load_preset("reaching-smoke")
IMITATION = load_preset("reaching-ch4-horizon30")

INCARNATION = "2f7086a1147f6071"
SEEDS = [6375474604893067239, 8514611595815388268]
ACTIONS = [[4, 4, 4, 4, 4, 0, 4, 4, 4, 4], [8, 4, 4, 4, 4, 4, 4, 4, 4, 9]]
RETURNS = [-12.140911, -12.009935, -11.47462, -13.062134, -11.231134]


def as_bytes(demonstrations: Demonstrations) -> list[bytes]:
    """What was demonstrated, without the time of day."""
    return [encode(replace(it, ended_unix_secs=0.0)) for it in demonstrations.trajectories]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes."""
    folder = tmp_path_factory.mktemp("undisturbed") / "demos"
    make_demonstrations(PRESET, folder, 6, by_script(PRESET, 0.2))
    return folder


# What is made ----------------------------------------------------------------------------------


def test_seeds_and_actions_are_those_that_demonstrations_always_had(undisturbed: Path) -> None:
    """What experiments have learned from does not change under them."""
    made = read_demonstrations(undisturbed).trajectories
    assert [it.ticket.index for it in made] == list(range(6))
    assert [it.ticket.seed for it in made] == [derive_seed(PRESET.seed, k, 0, 0) for k in range(6)]
    assert {(it.ticket.attempt, it.ticket.part, it.ticket.policy_version) for it in made} == {
        (0, 0, 0)
    }
    assert [it.ticket.seed for it in made[:2]] == SEEDS
    assert {it.id.incarnation for it in made} == {INCARNATION}
    assert [it.actions.tolist() for it in made[:2]] == ACTIONS
    assert [round(it.return_, 6) for it in made[:5]] == RETURNS


def test_a_guarded_episode_is_played_again_on_the_next_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def guarded_at_first(*arguments: object) -> Trajectory:
        played = collect(*arguments)  # type: ignore[arg-type]
        bad = played.ticket.index == 1 and played.ticket.attempt < 2
        return replace(played, guard="overstretched") if bad else played

    monkeypatch.setattr(making, "collect", guarded_at_first)
    made = make_demonstrations(PRESET, tmp_path, 2, by_script(PRESET, 0.2)).trajectories
    assert [it.ticket.attempt for it in made] == [0, 2]
    assert made[1].ticket.seed == derive_seed(PRESET.seed, 1, 2, 0)
    pictures = [view for view in views_in(tmp_path) if view.ticket == 1]
    assert {view.attempt for view in pictures} == {2}


def test_the_record_says_who_demonstrated_what_by_which_version(undisturbed: Path) -> None:
    origin = read_demonstrations(undisturbed).origin
    assert isinstance(origin, DemonstrationsBegun)
    assert origin.demonstrator == by_script(PRESET, 0.2).who
    assert origin.preset_json == PRESET.to_json()
    assert (origin.draw, origin.software_version) == (0, VERSION)


def views_in(folder: Path) -> list[View]:
    items = iter_recording(folder, ["view/demonstrator"])
    return [view for item in items if isinstance(view := item.decode(), View)]


def test_viewers_find_every_state_as_a_picture_at_its_time(undisturbed: Path) -> None:
    (segment,) = undisturbed.glob("*.mcap")
    reader = make_reader(BytesIO(segment.read_bytes()), validate_crcs=True)
    pictures = [
        (message, schema)
        for schema, channel, message in reader.iter_messages(log_time_order=False)
        if channel.topic == "view/demonstrator/image"
    ]
    made, views = read_demonstrations(undisturbed), views_in(undisturbed)
    assert len(pictures) == len(views) == made.samples + 6
    for (message, schema), view in zip(pictures, views, strict=True):
        assert schema is not None
        assert (schema.name, schema.encoding) == ("foxglove.CompressedImage", "protobuf")
        assert view.picture in message.data
        assert message.log_time == message.publish_time == round(view.unix_secs * 1e9)
    actions = [view.action for view in views if view.step]
    assert actions == [int(it) for each in made.trajectories for it in each.actions]
    assert list(iter_recording(undisturbed, ["gap"])) == []


# Killed and continued --------------------------------------------------------------------------


def test_they_are_a_whole_recording(undisturbed: Path) -> None:
    assert [it for it in RecordingCheck(undisturbed).findings() if it.is_fault] == []


def test_kill_9_at_any_moment_changes_nothing(undisturbed: Path, tmp_path: Path) -> None:
    folder = tmp_path / "demos"
    command = [sys.executable, "-m", "deploy.cli", "demos", "make", "reaching-smoke"]
    command += ["--output", str(folder), "--episodes", "6", "--mistakes", "0.2"]
    for last in ("episode 1:", "episode 3:"):
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert any(line.startswith(last) for line in process.stdout)
            process.send_signal(signal.SIGKILL)
        with pytest.raises(StorageError, match="expected a finished segment"):
            read_demonstrations(folder)
    finished = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "episode 3:" not in finished, "it was there already"
    assert "episode 5:" in finished
    assert as_bytes(read_demonstrations(folder)) == as_bytes(read_demonstrations(undisturbed))


@pytest.mark.parametrize("portion", [0.0, 0.01, 0.3, 0.6, 0.95])
def test_a_file_that_is_cut_off_anywhere_goes_on(
    undisturbed: Path, tmp_path: Path, portion: float
) -> None:
    folder = tmp_path / "demos"
    shutil.copytree(undisturbed, folder)
    segment = folder / "000000.mcap"
    whole = segment.read_bytes()
    segment.write_bytes(whole[: int(portion * len(whole))])
    made: list[int] = []
    again = make_demonstrations(
        PRESET,
        folder,
        6,
        by_script(PRESET, 0.2),
        on_episode=lambda it, _: made.append(it.id.sequence),
    )
    assert made == list(range(6 - len(made), 6)), "exactly what was missing"
    assert as_bytes(again) == as_bytes(read_demonstrations(undisturbed))
    assert as_bytes(read_demonstrations(folder)) == as_bytes(again)


def test_what_is_complete_is_not_touched_and_more_can_be_made(
    undisturbed: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "demos"
    few = make_demonstrations(PRESET, folder, 4, by_script(PRESET, 0.2))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    again = make_demonstrations(PRESET, folder, 3, by_script(PRESET, 0.2))
    assert as_bytes(again) == as_bytes(few)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    more = make_demonstrations(PRESET, folder, 6, by_script(PRESET, 0.2))
    assert as_bytes(more) == as_bytes(read_demonstrations(undisturbed))
    assert [path.name for path in sorted(folder.glob("*.mcap"))] == ["000000.mcap", "000001.mcap"]


def test_an_interrupted_command_leaves_a_file_that_can_be_read(tmp_path: Path) -> None:
    def interrupt(trajectory: Trajectory, draw: int) -> None:
        if trajectory.ticket.index == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_demonstrations(PRESET, tmp_path, 6, by_script(PRESET, 0.2), on_episode=interrupt)
    assert len(read_demonstrations(tmp_path).trajectories) == 2


# Refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "rate", "differs"),
    [
        ((), 0.3, "got those of reaching-smoke by the script, 0.2 .*another demonstrator"),
        (("task.horizon=9",), 0.2, "another task"),
        (("seed=1",), 0.3, "another demonstrator, seed"),
    ],
)
def test_others_demonstrations_are_refused_by_name(
    undisturbed: Path, settings: tuple[str, ...], rate: float, differs: str
) -> None:
    other = load_preset("reaching-smoke", settings)
    before = (undisturbed / "000000.mcap").read_bytes()
    with pytest.raises(StorageError, match=differs):
        make_demonstrations(other, undisturbed, 7, by_script(other, rate))
    with pytest.raises(StorageError, match="by chance; got those"):
        make_demonstrations(PRESET, undisturbed, 7, by_chance(PRESET))
    assert [path.name for path in undisturbed.glob("*.mcap")] == ["000000.mcap"]
    assert (undisturbed / "000000.mcap").read_bytes() == before


def test_what_is_learned_from_them_does_not_matter(undisturbed: Path, tmp_path: Path) -> None:
    shutil.copytree(undisturbed, tmp_path / "demos")
    other = load_preset("reaching-smoke", ["schedule.epochs=7", "algorithm.eta=2.0"])
    made = make_demonstrations(other, tmp_path / "demos", 6, by_script(other, 0.2))
    assert as_bytes(made) == as_bytes(read_demonstrations(undisturbed))


def test_folders_of_other_things_are_refused(tmp_path: Path) -> None:
    with Recording(tmp_path, "run", "rec-1") as recording:
        recording.finish()
    with pytest.raises(StorageError, match="expected one of run demonstrations; got one of run"):
        DemonstrationFolder(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "journal.sqlite").touch()
    with pytest.raises(StorageError, match="of `clothbus demos make`; got a run folder"):
        make_demonstrations(PRESET, tmp_path / "run", 1, by_chance(PRESET))
    with pytest.raises(StorageError, match="expected demonstrations, a run folder or a run's"):
        read_demonstrations(tmp_path / "nowhere")


def test_one_process_at_a_time(tmp_path: Path) -> None:
    with DemonstrationFolder(tmp_path), pytest.raises(AlreadyOwned, match="expected no other"):
        make_demonstrations(PRESET, tmp_path, 1, by_chance(PRESET))
    make_demonstrations(PRESET, tmp_path, 1, by_chance(PRESET))


def test_a_full_disk_is_said_in_words_and_nothing_that_was_there_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(recording: Recording) -> None:
        raise OSError(28, "No space left on device")

    make_demonstrations(PRESET, tmp_path, 2, by_script(PRESET, 0.2))
    with monkeypatch.context() as patched:
        patched.setattr(Recording, "flush", full)
        with pytest.raises(
            StorageError, match=r"expected a disk that can be written; got .*No space"
        ):
            make_demonstrations(PRESET, tmp_path, 3, by_script(PRESET, 0.2))
    made = make_demonstrations(PRESET, tmp_path, 3, by_script(PRESET, 0.2))
    assert [it.ticket.index for it in made.trajectories] == [0, 1, 2]


# Draws -----------------------------------------------------------------------------------------


def test_all_are_drawn_anew_until_there_are_targets_and_the_draw_is_kept(tmp_path: Path) -> None:
    demonstrator = by_script(IMITATION, 0.2)
    draws: list[int] = []

    def make(episodes: int) -> Demonstrations:
        return make_demonstrations(
            IMITATION, tmp_path, episodes, demonstrator, 3, lambda _, draw: draws.append(draw)
        )

    made = make(1)
    assert draws == [0, 1], "one episode each"
    (first,) = made.trajectories
    seed = making.preset_of_draw(IMITATION, 1).seed
    assert first.ticket.seed == derive_seed(seed, 0, 0, 0)
    assert np.sum(first.rewards >= -0.1) >= 3
    read = read_demonstrations(tmp_path)
    assert as_bytes(read) == as_bytes(made), "what came before is void"
    assert isinstance(read.origin, DemonstrationsBegun)
    assert read.origin.draw == 1
    assert as_bytes(make(2))[:1] == as_bytes(made)
    assert draws == [0, 1, 1], "the draw was gone on with"


def test_a_demonstrator_that_never_gets_there_is_told_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(making, "MOST_DRAWS", 3)
    with pytest.raises(StorageError, match=r"at least 3 target states among 1 .* one of 3 draws"):
        make_demonstrations(PRESET, tmp_path, 1, by_chance(PRESET), 3)


# Policies under training -----------------------------------------------------------------------


def trained(path: Path, *settings: str) -> RunFolder:
    preset = load_preset("reaching-smoke", settings)
    folder = prepare_run_folder(path, preset)
    options = RunOptions(actors=1)
    assert run_in_process(folder, preset, options, Console(quiet=True))
    return folder


@pytest.mark.parametrize("method", ["dpn", "dqn"])
def test_a_policy_demonstrates_as_it_acts_in_its_run(tmp_path: Path, method: str) -> None:
    exploration = ["exploration.epsilon_start=0.9", "exploration.epsilon_end=0.1"]
    exploration += ["exploration.decay_episodes=4"]
    extra = [f"algorithm.method={method}", "algorithm.head=plain", *exploration]
    run = trained(tmp_path / "smoke", *extra)
    demonstrator = by_policy(PRESET, run, 2)
    played = demonstrator.who.snapshot
    assert played is not None
    assert (played.run, played.version) == ("smoke", 2)
    assert played.epsilon == (0.5 if method == "dqn" else 0.0)
    made = make_demonstrations(PRESET, tmp_path / "demos", 2, demonstrator)
    weights = (run.snapshots / "000002.safetensors").read_bytes()
    policy = Policy.from_bytes(run.read_preset().network, weights)
    acting = EpsilonGreedy(policy) if method == "dqn" else Sampled(policy)
    for index, each in enumerate(made.trajectories):
        assert (each.ticket.policy_version, each.ticket.epsilon) == (2, played.epsilon)
        env = make_task_env(PRESET.task)
        alone = collect(env, acting, each.ticket, TrajectoryId("a", "b", index))
        np.testing.assert_array_equal(alone.observations, each.observations)
        np.testing.assert_array_equal(alone.actions, each.actions)
    with pytest.raises(
        StorageError, match=r"by policy 4 of smoke.*got those.*by policy 2 of smoke"
    ):
        make_demonstrations(PRESET, tmp_path / "demos", 2, by_policy(PRESET, run))
    with pytest.raises(StorageError, match=r"policy versions 0, .*which are kept; got 77"):
        by_policy(PRESET, run, 77)
    with pytest.raises(PresetError, match="expected a policy for reaching-ch4-horizon30"):
        by_policy(IMITATION, run)


def test_the_trajectories_of_a_run_are_demonstrations_too(tmp_path: Path) -> None:
    run = trained(tmp_path / "smoke")
    read = read_demonstrations(run.path)
    assert isinstance(read.origin, RunStarted)
    assert [it.ticket.index for it in read.trajectories] == list(range(4))
    assert read.marks is None


# A quality -------------------------------------------------------------------------------------


def test_a_quality_is_found_once_and_kept_in_the_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "demos"
    first = by_script_of_quality(PRESET, folder, 0.5, 6)
    made = make_demonstrations(PRESET, folder, 2, first)
    assert isinstance(made.origin, DemonstrationsBegun)
    assert made.origin.demonstrator == first.who
    assert made.origin.demonstrator.quality is not None
    monkeypatch.setattr(
        "deploy.demonstrations.demonstrators.find_quality", None
    )  # it is not asked again
    assert by_script_of_quality(PRESET, folder, 0.5, 6).who == first.who
    for wanted, episodes in ((0.6, 6), (0.5, 7)):
        with pytest.raises(StorageError, match=f"of quality {wanted:g}, measured over {episodes}"):
            by_script_of_quality(PRESET, folder, wanted, episodes)


# Several processes -----------------------------------------------------------------------------


def test_experiments_share_demonstrations_with_whoever_makes_them_meanwhile(
    tmp_path: Path,
) -> None:
    """Each waits for the other's file lock, as processes do."""
    plan = next(it for it in find("figure-4.5").plans() if it.preset.seed == 0)
    with ThreadPoolExecutor(2) as pool:
        mine, theirs = pool.map(lambda _: demonstrations_of(plan, tmp_path), range(2))
    assert [encode(it) for it in mine] == [encode(it) for it in theirs], "to the very time of day"
    assert len(mine) == 5
    segments = tmp_path.glob("demonstrations/*/*.mcap")
    assert {path.name for path in segments} == {"000000.mcap"}, "one made them, one read them"
