"""The learning loop: order of commits, restarts, initialisation; with real files and no bus."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from actors.task import make_task_env
from broker_config.codec import decode
from broker_config.errors import PresetError
from broker_config.journal import Journal
from broker_config.messages import IterationEnded, SnapshotTaken, weights_digest
from broker_config.preset import InitialisationPreset, Preset
from deploy.demonstrations.demonstrators import by_script
from deploy.demonstrations.making import make_demonstrations
from deploy.presets import load_preset
from deploy.running.in_process import InProcessActor
from learner.checkpoint import CheckpointStore
from learner.learning import EpisodeAbsorbed, LearningLoop, PolicyReady
from learner.owner import Owner
from learner.recorded import Demonstrations, read_demonstrations
from learner.snapshots import SnapshotStore
from learner.trainer import Trainer

PRESET = load_preset("reaching-smoke", ["schedule.iterations=3"])

Events = Iterator[PolicyReady | EpisodeAbsorbed]
Begin = Callable[..., Events]


def beginner(folder: Path, stack: ExitStack) -> Begin:
    """Begins or resumes runs in folders of this one, as fresh processes would."""

    def begin_one(
        name: str = "run",
        preset: Preset = PRESET,
        demonstrations: Demonstrations | None = None,
    ) -> Events:
        run = folder / name
        run.mkdir(exist_ok=True)
        journal = stack.enter_context(Journal(run / "journal.sqlite"))
        owner = Owner("run", preset, journal)
        snapshots = SnapshotStore(run / "snapshots")
        env = make_task_env(preset.task)
        actor = InProcessActor(owner, env, snapshots)
        loop = LearningLoop(
            owner,
            Trainer(preset),
            CheckpointStore(run / "checkpoints"),
            snapshots,
            demonstrations,
            actor.play_until_ready,
        )
        return iter(loop)

    return begin_one


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Begin]:
    """Begins or resumes a run in a folder, as a fresh process would."""
    with ExitStack() as stack:
        yield beginner(tmp_path, stack)


def final_weights(events: Events) -> bytes:
    return [event.snapshot.weights for event in events if isinstance(event, PolicyReady)][-1]


def test_a_run_yields_each_episode_and_each_version_in_order(begin: Begin) -> None:
    events = list(begin())
    versions = [event.snapshot.version for event in events if isinstance(event, PolicyReady)]
    indices = [event.index for event in events if isinstance(event, EpisodeAbsorbed)]
    assert versions == list(range(7))
    assert indices == list(range(6))
    assert {event.policy_lag for event in events if isinstance(event, EpisodeAbsorbed)} == {0}


def test_a_policy_lag_is_exact(begin: Begin) -> None:
    lagged = load_preset("reaching-smoke", ["schedule.policy_lag=2"])
    episodes = [event for event in begin(preset=lagged) if isinstance(event, EpisodeAbsorbed)]
    assert [episode.policy_lag for episode in episodes] == [0, 1, 2, 2]


def test_once_per_iteration_updates_at_its_end_only(begin: Begin) -> None:
    preset = load_preset("reaching-smoke", ["schedule.update_every=iteration"])
    kinds = [type(event) for event in begin(preset=preset)]
    absorbed = [EpisodeAbsorbed, EpisodeAbsorbed]
    assert kinds == [PolicyReady, *absorbed, PolicyReady, *absorbed, PolicyReady]


@pytest.fixture(scope="module", params=["episode", "iteration"])
def undisturbed(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Preset, bytes]:
    """A preset, and the weights with which its run ends."""
    settings = ["schedule.iterations=3", f"schedule.update_every={request.param}"]
    preset = load_preset("reaching-smoke", settings)
    with ExitStack() as stack:
        begin = beginner(tmp_path_factory.mktemp("undisturbed"), stack)
        return preset, final_weights(begin(preset=preset))


@pytest.mark.parametrize("stops_after", [1, 2, 4, 5, 7])
def test_a_run_that_dies_anywhere_ends_with_the_same_weights(
    begin: Begin, undisturbed: tuple[Preset, bytes], stops_after: int
) -> None:
    preset, expected = undisturbed
    dying = begin("dying", preset)
    for _ in range(stops_after):
        next(dying, None)
    assert final_weights(begin("dying", preset)) == expected


def test_snapshots_and_iterations_are_journalled_with_their_digests(
    begin: Begin, tmp_path: Path
) -> None:
    list(begin())
    store = SnapshotStore(tmp_path / "run" / "snapshots")
    assert {0, 2, 4, 5, 6} == set(store.versions())
    with Journal(tmp_path / "run" / "journal.sqlite") as journal:
        taken = [decode(it.payload, SnapshotTaken) for it in journal.entries("snapshot/")]
        ended = [decode(it.payload, IterationEnded) for it in journal.entries("iteration/")]
    assert [it.version for it in taken] == list(range(7))
    for version in store.versions():
        assert taken[version].digest == weights_digest(store.get(version) or b"")
    assert [it.iteration for it in ended] == [0, 1, 2]
    assert len({it.digest for it in ended}) == 3


def test_algorithm_2_initialises_from_demonstrations_and_survives_a_restart(
    begin: Begin, tmp_path: Path
) -> None:
    wanted = InitialisationPreset(demonstration_samples=25, target_switches=3)
    preset = dataclasses.replace(PRESET, initialisation=wanted)
    made = make_demonstrations(PRESET, tmp_path / "demos", 3, by_script(PRESET, 0.2))
    demonstrations = read_demonstrations(tmp_path / "demos")
    assert [it.id for it in demonstrations.trajectories] == [it.id for it in made.trajectories]
    first = next(begin("run", preset, demonstrations))
    assert isinstance(first, PolicyReady)
    assert first.report is not None
    assert len(first.report.losses) == 3
    untrained = next(begin("untrained"))
    assert isinstance(untrained, PolicyReady)
    assert first.snapshot.digest != untrained.snapshot.digest
    again = next(begin("run", preset))  # the journal has the demonstrations
    assert isinstance(again, PolicyReady)
    assert again.snapshot.digest == first.snapshot.digest


def test_too_few_demonstrations_are_refused_with_both_numbers(begin: Begin) -> None:
    wanted = InitialisationPreset(demonstration_samples=25, target_switches=3)
    with pytest.raises(PresetError, match="expected 25 demonstration samples; got 0"):
        next(begin("run", dataclasses.replace(PRESET, initialisation=wanted)))
