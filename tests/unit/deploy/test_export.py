"""`clothbus export` and `clothbus demos import`: nothing is lost, and nothing half-written."""

from __future__ import annotations

import json
import sys
import tracemalloc
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from actors.envs import make_env
from broker_config.codec import encode
from broker_config.errors import PresetError, StorageError
from broker_config.journal import Journal
from broker_config.messages import DemonstrationsBegun, Trajectory
from broker_config.version import VERSION
from deploy.cli import app
from deploy.demonstrations.demonstrators import by_script
from deploy.demonstrations.folder import DemonstrationWriter, label_targets
from deploy.demonstrations.making import make_demonstrations
from deploy.exchange.npz import export_npz
from deploy.exchange.source import open_source
from deploy.presets import load_preset
from deploy.run_folder import RunFolder, prepare_run_folder
from deploy.running.run import RunOptions
from deploy.running.run_in_process import run_in_process
from learner.recorded import Demonstrations, read_demonstrations

Capture = pytest.CaptureFixture[str]
MakeTrajectory = Callable[..., Trajectory]

PRESET = load_preset("reaching-smoke")
CLOTH = load_preset("handkerchief-ch3")


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four demonstrations; states of one are marked."""
    folder = tmp_path_factory.mktemp("made") / "demos"
    make_demonstrations(PRESET, folder, 4, by_script(PRESET, 0.3))
    label_targets(folder, {1: [3, 5]})
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole run of the smoke preset."""
    folder = prepare_run_folder(tmp_path_factory.mktemp("runs") / "run", PRESET)
    assert run_in_process(folder, PRESET, RunOptions(actors=1), Console(quiet=True))
    return folder.path


@pytest.fixture
def dataset(demos: Path, tmp_path: Path) -> Path:
    """The demonstrations as a Minari dataset."""
    export_minari(demos, tmp_path / "given-v0")
    return tmp_path / "given-v0"


def export_minari(source: Path, output: Path) -> None:
    pytest.importorskip("h5py", reason="h5py is not installed: pip install clothbus[hdf5]")
    app.cli(args=["export", str(source), "--to", "minari", "--output", str(output)])


def import_minari(dataset: Path | str, output: Path, *settings: str) -> Demonstrations:
    given = ["--set", *settings] if settings else []
    preset = ["--preset", PRESET.name, "--output", str(output), *given]
    app.cli(args=["demos", "import", str(dataset), *preset])
    return read_demonstrations(output)


def as_bytes(demonstrations: Demonstrations) -> list[bytes]:
    """Every bit of every trajectory."""
    return [encode(it) for it in demonstrations.trajectories]


def h5(dataset: Path):  # type: ignore[no-untyped-def]  # h5py publishes no types
    """The file with a dataset's episodes, to be changed."""
    return pytest.importorskip("h5py").File(dataset / "data" / "main_data.hdf5", "a")


# NPZ -------------------------------------------------------------------------------------------


def test_npz_has_every_array_and_all_that_is_known(demos: Path, tmp_path: Path) -> None:
    app.cli(args=["export", str(demos), "--to", "npz", "--output", str(tmp_path / "out")])
    lines = (tmp_path / "out" / "episodes.jsonl").read_text().splitlines()
    made = read_demonstrations(demos).trajectories
    for line, trajectory in zip(map(json.loads, lines), made, strict=True):
        with np.load(tmp_path / "out" / line["file"]) as arrays:
            for name in ("observations", "actions", "rewards"):
                expected = getattr(trajectory, name)
                assert arrays[name].dtype == expected.dtype
                np.testing.assert_array_equal(arrays[name], expected)
            assert arrays["truncations"].tolist() == [False] * 9 + [True]
            assert not arrays["terminations"].any()
        assert line["ticket"] == vars(trajectory.ticket)
        assert line["id"] == vars(trajectory.id)
        assert (line["steps"], line["success"]) == (10, trajectory.success)
        assert line["return"] == trajectory.return_
    assert [json.loads(line)["targets"] for line in lines] == [[], [3, 5], [], []]
    about = json.loads((tmp_path / "out" / "dataset.json").read_text())
    assert about["preset"] == json.loads(PRESET.to_json())
    assert (about["trajectories"], about["steps"]) == (4, 40)
    assert about["acted"] == "the script, 0.3 of its actions random"


def test_a_reset_with_the_exported_seed_gives_the_first_observation(
    demos: Path, tmp_path: Path
) -> None:
    export_npz(open_source(demos), tmp_path / "out")
    first = json.loads((tmp_path / "out" / "episodes.jsonl").read_text().splitlines()[2])
    task = PRESET.task
    with closing(make_env(task.environment, horizon=task.horizon, **task.options)) as env:
        observation, _ = env.reset(seed=first["reset_seed"])
    with np.load(tmp_path / "out" / first["file"]) as arrays:
        np.testing.assert_array_equal(arrays["observations"][0], observation)


def test_a_run_exports_what_counts_in_the_order_of_its_tickets(run: Path, tmp_path: Path) -> None:
    app.cli(args=["export", str(run), "--to", "npz", "--output", str(tmp_path / "out")])
    lines = (tmp_path / "out" / "episodes.jsonl").read_text().splitlines()
    tickets = [json.loads(line)["ticket"] for line in lines]
    assert [it["index"] for it in tickets] == list(range(PRESET.schedule.episodes))
    versions = [PRESET.schedule.policy_version(it["index"]) for it in tickets]
    assert [it["policy_version"] for it in tickets] == versions
    about = json.loads((tmp_path / "out" / "dataset.json").read_text())
    assert about["acted"] == f"{PRESET.algorithm.method} under training"


# A round trip over Minari ----------------------------------------------------------------------


def test_a_round_trip_gives_every_bit_again(demos: Path, dataset: Path, tmp_path: Path) -> None:
    before, after = read_demonstrations(demos), import_minari(dataset, tmp_path / "back")
    assert as_bytes(after) == as_bytes(before)
    assert after.marks == before.marks
    assert isinstance(after.origin, DemonstrationsBegun)
    assert isinstance(before.origin, DemonstrationsBegun)
    who = after.origin.demonstrator
    assert who.kind == "imported"
    assert who.dataset is not None
    assert who.dataset.id == "clothbus/given-v0"
    assert who.dataset.algorithm == str(before.origin.demonstrator)
    again = tmp_path / "again"
    export_minari(tmp_path / "back", again)
    assert as_bytes(import_minari(again, tmp_path / "twice")) == as_bytes(before)


def test_a_run_is_imported_as_what_its_policies_demonstrated(run: Path, tmp_path: Path) -> None:
    export_minari(run, tmp_path / "run-v3")
    after = import_minari(tmp_path / "run-v3" / "data", tmp_path / "back")
    assert as_bytes(after) == as_bytes(read_demonstrations(run))


def test_parts_interruptions_guards_and_terminations_survive(
    tmp_path: Path, make_trajectory: MakeTrajectory
) -> None:
    pytest.importorskip("h5py", reason="h5py is not installed: pip install clothbus[hdf5]")
    whole = make_trajectory(0)
    ticket = replace(whole.ticket, index=5, attempt=2, part=1, seed=2**63 - 1, epsilon=0.1)
    odd = replace(
        make_trajectory(1, steps=1), ticket=ticket, interrupted=True, guard="overstretched"
    )
    ended = replace(make_trajectory(2), terminated=True, truncated=False, success=True)
    given = [whole, odd, ended]
    write(tmp_path / "demos", given)
    export_minari(tmp_path / "demos", tmp_path / "cloth-v1")
    target = ["--preset", CLOTH.name, "--output", str(tmp_path / "back")]
    app.cli(args=["demos", "import", str(tmp_path / "cloth-v1"), *target])
    assert as_bytes(read_demonstrations(tmp_path / "back")) == [encode(it) for it in given]


def write(folder: Path, trajectories: list[Trajectory]) -> None:
    who = by_script(CLOTH, 0.0).who
    with DemonstrationWriter(folder) as writer:
        writer.begin(DemonstrationsBegun(who, 0, CLOTH.to_json(), VERSION))
        for trajectory in trajectories:
            writer.add(trajectory, [1.0] * (trajectory.steps + 1))


@pytest.mark.parametrize("work", ["npz", "minari", "import"])
def test_memory_does_not_grow_with_the_file(
    work: str, tmp_path: Path, make_trajectory: MakeTrajectory
) -> None:
    """Pictures of chance cannot be compressed: an episode is 0.6 MB, all are 13."""
    pytest.importorskip("h5py", reason="h5py is not installed: pip install clothbus[hdf5]")

    def peak_bytes(episodes: int) -> int:
        made, output = tmp_path / f"{episodes}", tmp_path / f"{episodes}-v0"
        write(made, [make_trajectory(it, steps=30) for it in range(episodes)])
        command = ["export", str(made), "--to", work, "--output", str(output)]
        if work == "import":
            export_minari(made, output)
            command = ["demos", "import", str(output), "--preset", CLOTH.name]
            command += ["--output", str(tmp_path / f"{episodes}-back")]
        tracemalloc.start()
        try:
            app.cli(args=command)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak_bytes(1)  # imports modules, which stay
    assert peak_bytes(20) < peak_bytes(4) + 2_000_000


# What is refused -------------------------------------------------------------------------------


def test_nothing_is_overwritten(demos: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    for name in ("mine", "other"):
        (tmp_path / "other.partial").mkdir(exist_ok=True)
        with pytest.raises(StorageError, match="expected a folder that is not there yet"):
            export_npz(open_source(demos), tmp_path / name)
    assert list((tmp_path / "mine").iterdir()) == []


def test_without_h5py_minari_is_refused_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    command = ["export", str(tmp_path / "nowhere"), "--to", "minari", "--output", "new-v0"]
    with pytest.raises(PresetError, match=r"it is not installed; pip install clothbus\[hdf5\]"):
        app.cli(args=command)


def test_what_holds_no_episode_is_no_source(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="expected a run folder, a recording or demonstrations"):
        open_source(tmp_path)
    write(tmp_path / "empty", [])
    with pytest.raises(StorageError, match="expected at least one demonstration; got none"):
        open_source(tmp_path / "empty")
    folder: RunFolder = prepare_run_folder(tmp_path / "run", PRESET)
    Journal(folder.journal).close()
    with pytest.raises(StorageError, match="at least one whole episode"):
        open_source(folder.path)


def test_a_dataset_without_a_name_to_minari_is_refused(demos: Path, tmp_path: Path) -> None:
    with pytest.raises(PresetError, match="expected a folder whose name is one of a Minari"):
        export_minari(demos, tmp_path / "not a name")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("preset", "settings", "message"),
    [
        ("handkerchief-ch3", "task.horizon=30", r"expected observations uint8 \[84, 84, 3\]"),
        ("reaching-smoke", "task.horizon=9", r"episode 0: expected 1 to 9 steps .*got 10"),
        ("reaching-ch3", "task.horizon=30", r"expected actions 0 to \d+"),
    ],
)
def test_a_dataset_of_another_task_is_refused(
    dataset: Path, tmp_path: Path, preset: str, settings: str, message: str
) -> None:
    target = ["--preset", preset, "--output", str(tmp_path / "back"), "--set", settings]
    with pytest.raises(StorageError, match=message):
        app.cli(args=["demos", "import", str(dataset), *target])
    assert [it.name for it in tmp_path.iterdir()] == ["given-v0"]


DAMAGES = {
    "actions: expected 0 to 9; got -1": ("actions", np.full(10, -1)),
    r"actions: expected one for each of 10 steps.*float64 \[10\]": ("actions", np.zeros(10)),
    r"actions: expected one for each of 10 steps.*\[3\]": ("actions", np.zeros(3, np.int64)),
    "terminations: expected none before the last": ("terminations", np.ones(10, np.bool_)),
    "rewards: expected finite numbers": ("rewards", np.full(10, 1e300)),
    r"observations: expected uint8 \[11, 84": ("observations", np.zeros((10, 84, 84, 1), np.uint8)),
    "expected an episode as Minari writes it": ("truncations", None),
}


@pytest.mark.parametrize("message", DAMAGES)
def test_a_damaged_episode_is_refused_with_its_number(
    dataset: Path, tmp_path: Path, message: str
) -> None:
    key, array = DAMAGES[message]
    with h5(dataset) as file:
        del file[f"episode_2/{key}"]
        if array is not None:
            file[f"episode_2/{key}"] = array
    with pytest.raises(StorageError, match=f"clothbus/given-v0: episode 2: .*{message}"):
        import_minari(dataset, tmp_path / "back")
    assert [it.name for it in tmp_path.iterdir()] == ["given-v0"]


def test_changed_facts_are_refused(dataset: Path, tmp_path: Path) -> None:
    with h5(dataset) as file:
        file["episode_1"].attrs["clothbus/ticket/index"] = -3
    with pytest.raises(StorageError, match=r"episode 1: ticket\.index: expected a count.*got -3"):
        import_minari(dataset, tmp_path / "back")
    with h5(dataset) as file:
        file["episode_1"].attrs["clothbus/ticket/index"] = 1
        file["episode_1"].attrs["clothbus/id/sequence"] = 0
    with pytest.raises(StorageError, match="expected each trajectory once; got demonstrator"):
        import_minari(dataset, tmp_path / "back")
    with h5(dataset) as file:
        del file["episode_3"]
    with pytest.raises(StorageError, match="expected 4 episodes; got 3"):
        import_minari(dataset, tmp_path / "back")


def test_what_is_no_dataset_is_refused(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="expected a Minari dataset's folder, or its name in"):
        import_minari("nobody/knows-v0", tmp_path / "back")
    (dataset / "data" / "main_data.hdf5").write_bytes(b"nothing")
    with pytest.raises(StorageError, match="expected an HDF5 file"):
        import_minari(dataset, tmp_path / "back")
    metadata = dataset / "data" / "metadata.json"
    metadata.write_text(metadata.read_text().replace('"hdf5"', '"arrow"'))
    with pytest.raises(StorageError, match="expected episodes as hdf5; got arrow"):
        import_minari(dataset, tmp_path / "back")
