"""Minari itself reads what clothbus exports, and clothbus reads what Minari writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

from broker_config.errors import StorageError
from broker_config.messages import Trajectory
from broker_config.preset import Preset
from broker_config.version import VERSION
from deploy.cli import app
from deploy.demonstrations.demonstrators import by_script
from deploy.demonstrations.making import make_demonstrations
from deploy.presets import load_preset
from learner.recorded import Demonstrations, read_demonstrations

minari: Any = pytest.importorskip(
    "minari", reason="Minari is not installed: pip install clothbus[minari]"
)
EpisodeBuffer = minari.data_collector.EpisodeBuffer

PRESET = load_preset("reaching-smoke")
CLOTH = load_preset("handkerchief-ch3")
PICTURES = Box(0, 255, PRESET.task.observation_shape, np.uint8)
ACTIONS = Discrete(PRESET.task.n_actions)


@pytest.fixture(autouse=True)
def local_storage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Minari's, of this test."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    (tmp_path / "minari").mkdir()
    return tmp_path / "minari"


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three demonstrations."""
    folder = tmp_path_factory.mktemp("made") / "demos"
    make_demonstrations(PRESET, folder, 3, by_script(PRESET, 0.3))
    return folder


@pytest.fixture
def exported(demos: Path, local_storage: Path) -> Any:
    """They, as Minari loads them by their name."""
    output = local_storage / "reaching" / "scripted-v2"
    app.cli(args=["export", str(demos), "--to", "minari", "--output", str(output)])
    return minari.load_dataset("reaching/scripted-v2")


def import_by_name(name: str, output: Path, preset: Preset = PRESET) -> Demonstrations:
    app.cli(args=["demos", "import", name, "--preset", preset.name, "--output", str(output)])
    return read_demonstrations(output)


# What clothbus exports -------------------------------------------------------------------------


def test_minari_lists_and_loads_the_export(exported: Any) -> None:
    assert list(minari.list_local_datasets()) == ["reaching/scripted-v2"]
    assert list(minari.list_local_datasets(compatible_minari_version=True, latest_version=True))
    spec = exported.spec
    names = (spec.dataset_id, spec.namespace, spec.version)
    assert names == ("reaching/scripted-v2", "reaching", 2)
    assert (spec.total_episodes, spec.total_steps) == (3, 30)
    assert (spec.observation_space, spec.action_space) == (PICTURES, ACTIONS)
    assert spec.env_spec.id == PRESET.task.environment
    assert spec.env_spec.max_episode_steps == PRESET.task.horizon
    metadata = exported.storage.metadata
    assert metadata["requirements"] == [f"clothbus=={VERSION}"]
    assert metadata["algorithm_name"] == "the script, 0.3 of its actions random"
    assert metadata["clothbus"]["preset"]["name"] == PRESET.name


def test_every_episode_is_in_the_spaces_and_has_the_recorded_bits(
    exported: Any, demos: Path
) -> None:
    made = read_demonstrations(demos).trajectories
    said = list(exported.storage.get_episode_metadata(range(3)))
    for episode, metadata, trajectory in zip(exported, said, made, strict=True):
        check_episode(episode, trajectory)
        assert f"total_steps={trajectory.steps}" in repr(episode)
        own = metadata["clothbus"]
        assert metadata["total_steps"] == trajectory.steps
        assert own["success"] == trajectory.success
        assert own["ticket"]["policy_version"] == trajectory.ticket.policy_version
        assert own["id"]["incarnation"] == trajectory.id.incarnation
    assert sum(len(it) for it in exported) == exported.total_steps
    (sampled,) = exported.sample_episodes(1)
    check_episode(sampled, made[sampled.id])
    first = exported.filter_episodes(lambda it: it.id == 0)
    assert (first.total_episodes, first.total_steps) == (1, 10)


def check_episode(episode: Any, trajectory: Trajectory) -> None:
    steps = len(episode.rewards)
    assert len(episode.observations) == steps + 1
    assert len(episode.actions) == len(episode.terminations) == len(episode.truncations) == steps
    assert all(PICTURES.contains(it) for it in episode.observations)
    assert all(ACTIONS.contains(it) for it in episode.actions)
    for name in ("observations", "actions", "rewards"):
        np.testing.assert_array_equal(getattr(episode, name), getattr(trajectory, name))
    assert episode.terminations[-1] == trajectory.terminated
    assert episode.truncations[-1] == trajectory.truncated


def test_the_environment_is_made_again_and_its_seeds_give_the_first_observations(
    exported: Any,
) -> None:
    env = exported.recover_environment()
    assert (env.observation_space, env.action_space) == (PICTURES, ACTIONS)
    assert env.spec == exported.env_spec
    for episode, metadata in zip(
        exported, exported.storage.get_episode_metadata(range(3)), strict=True
    ):
        observation, _ = env.reset(seed=metadata["seed"])
        np.testing.assert_array_equal(observation, episode.observations[0])
        for action, expected in zip(episode.actions, episode.observations[1:], strict=True):
            observation, _, _, truncated, _ = env.step(int(action))
            np.testing.assert_array_equal(observation, expected)
        assert truncated
    env.close()


def test_minari_splits_the_export(exported: Any) -> None:
    part, rest = minari.split_dataset(exported, [1, 2], seed=0)
    assert (part.total_episodes, rest.total_episodes) == (1, 2)
    assert {it.id for it in (*part, *rest)} == {0, 1, 2}


# What Minari writes ----------------------------------------------------------------------------


def buffers(preset: Preset) -> list[Any]:
    """Two episodes: one is terminated with success after 4 steps, one is cut off after 10."""
    random, task = np.random.default_rng(0), preset.task
    return [
        EpisodeBuffer(
            observations=random.integers(0, 256, (steps + 1, *task.observation_shape), np.uint8),
            actions=random.integers(0, task.n_actions, steps),
            rewards=random.random(steps),
            terminations=[False] * (steps - 1) + [ends],
            truncations=[False] * steps,
            infos={"success": np.array([False] * steps + [ends])},
        )
        for steps, ends in ((4, True), (10, False))
    ]


def create(name: str, preset: Preset, given: list[Any], *, jpeg: bool = False) -> Any:
    return minari.create_dataset_from_buffers(
        name,
        given,
        observation_space=Box(0, 255, preset.task.observation_shape, np.uint8),
        action_space=Discrete(preset.task.n_actions),
        algorithm_name="a person",
        author="them",
        author_email="them@example.org",
        code_permalink="https://example.org",
        description="pictures",
        eval_env=preset.task.environment,
        jpeg_encoding=jpeg,
    )


@pytest.mark.filterwarnings("ignore:env_spec is None")
def test_raw_pictures_of_others_are_imported_as_they_are(tmp_path: Path) -> None:
    dataset = create("others/raw-v0", PRESET, buffers(PRESET))
    demonstrations = import_by_name("others/raw-v0", tmp_path / "back")
    first, second = demonstrations.trajectories
    for theirs, mine in zip(dataset, (first, second), strict=True):
        np.testing.assert_array_equal(mine.observations, theirs.observations)
        np.testing.assert_array_equal(mine.actions, theirs.actions)
        np.testing.assert_array_equal(mine.rewards, theirs.rewards.astype(np.float32))
    assert (first.terminated, first.truncated, first.success) == (True, False, True)
    assert (second.terminated, second.truncated, second.success) == (False, True, False)
    assert first.id.incarnation == second.id.incarnation
    assert [str(it.id).split("/")[::2] for it in (first, second)] == [
        ["imported", "0"],
        ["imported", "1"],
    ]
    origin: Any = demonstrations.origin
    assert str(origin.demonstrator).startswith("dataset others/raw-v0 (")
    assert str(origin.demonstrator).endswith("): a person")
    output = tmp_path / "again-v0"
    app.cli(args=["export", str(tmp_path / "back"), "--to", "minari", "--output", str(output)])
    (said, _) = minari.MinariDataset(output / "data").storage.get_episode_metadata([0, 1])
    assert "seed" not in said  # nobody knows of any that gives these pictures


@pytest.mark.filterwarnings("ignore:env_spec is None")
def test_pictures_that_minari_wrote_as_jpeg_are_decoded_as_minari_does(tmp_path: Path) -> None:
    dataset = create("others/jpeg-v0", CLOTH, buffers(CLOTH), jpeg=True)
    after = import_by_name("others/jpeg-v0", tmp_path / "back", CLOTH).trajectories
    for theirs, mine in zip(dataset, after, strict=True):
        np.testing.assert_array_equal(mine.observations, theirs.observations)


@pytest.mark.filterwarnings("ignore:env_spec is None")
def test_what_others_wrote_and_does_not_fit_leaves_nothing(tmp_path: Path) -> None:
    given = buffers(PRESET)
    given[1].actions[3] = PRESET.task.n_actions
    create("others/bad-v0", PRESET, given)
    n_actions = PRESET.task.n_actions
    message = f"others/bad-v0: episode 1: actions: expected 0 to {n_actions - 1}; got 0 to"
    with pytest.raises(StorageError, match=message):
        import_by_name("others/bad-v0", tmp_path / "back")
    assert [it.name for it in tmp_path.iterdir()] == ["minari"]
