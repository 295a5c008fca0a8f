import re
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

import deploy
from broker_config.preset import Preset, preset_from_json, preset_from_toml
from deploy.reproduce.catalogue import find_experiment
from deploy.reproduce.chapter4 import BID

FOLDER = Path(deploy.__file__).parent / "presets"
PATHS = sorted(FOLDER.glob("*.toml"))
PROVENANCE = re.compile(r"(table \d\.\d|section \d\.\d|chapter \d|eq\. \d|figure \d|algorithm \d)")
ASSUMED = re.compile(r"assumed: \S+")

TABLES = {
    # eta, sigma, M, T, E or N of the source's tables
    "reaching-ch3": (1.0, 0.0, 5, 30, 450),
    "handkerchief-ch3": (1.0, 0.0, 5, 30, 450),
    "tshirt-ch3": (1.0, 0.0, 5, 8, 120),
    "reaching-ch4": (1.0, 0.05, 10, 20, 2000),
    "handkerchief-ch4": (1.0, 0.05, 10, 30, 3000),
    "shirt-ch4": (0.7, 0.03, 10, 3, 800),
    "trousers-ch4": (0.7, 0.03, 10, 2, 800),
}
UPDATES = {"reaching-ch3": (2, 80), "handkerchief-ch3": (2, 40), "tshirt-ch3": (2, 30)}
INITIALISATIONS = {"handkerchief-ch3": (300, 20), "tshirt-ch3": (80, 5)}
IMITATIONS = {
    # J, K, demonstration samples
    "reaching-ch4": (10, 20, 100),
    "handkerchief-ch4": (5, 10, 100),
    "shirt-ch4": (10, 20, 15),
    "trousers-ch4": (10, 20, 10),
}
INITIALISE_REACHING = (
    "initialisation.demonstration_samples=300",
    "initialisation.target_switches=20",
)


def load(name: str, *overrides: str) -> Preset:
    return preset_from_toml((FOLDER / f"{name}.toml").read_text(), overrides)


def test_there_is_one_for_each_table_and_two_for_a_first_look() -> None:
    names = {path.stem for path in PATHS}
    assert names >= {*TABLES, "reaching-ch4-horizon30", "reaching-smoke", "handkerchief-quickstart"}


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_every_value_says_where_it_is_from(path: Path) -> None:
    lines = [line for line in path.read_text().splitlines() if re.match(r"\w+ =", line)]
    for line in lines:
        _, separator, comment = line.partition(" # ")
        assert separator, f"no provenance: {line}"
        assert PROVENANCE.search(comment) or ASSUMED.search(comment), f"no provenance: {line}"
    values = sum(
        len(part) if isinstance(part, dict) else 1
        for table in tomllib.loads(path.read_text()).values()
        for part in (table.values() if isinstance(table, dict) else [table])
    )
    assert len(lines) == values  # no value hides in a line of another form


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_every_preset_loads_and_keeps_its_digest(path: Path) -> None:
    preset = load(path.stem)
    assert preset.name == path.stem
    assert preset_from_json(preset.to_json()).digest == preset.digest


def test_names_and_digests_are_unique() -> None:
    assert len({load(path.stem).digest for path in PATHS}) == len(PATHS)


@pytest.mark.parametrize("name", TABLES)
def test_numbers_are_the_source_s(name: str) -> None:
    preset = load(name)
    algorithm, schedule = preset.algorithm, preset.schedule
    numbers = (
        algorithm.eta,
        algorithm.sigma,
        schedule.episodes_per_iteration,
        preset.task.horizon,
        schedule.memory_samples,
    )
    assert numbers == TABLES[name]
    optimiser = preset.optimiser
    assert (optimiser.name, optimiser.learning_rate) == ("rmsprop", 2.5e-4)
    assert (optimiser.smoothing, optimiser.epsilon) == (0.95, 1e-2)
    assert schedule.policy_lag == 0
    assert schedule.subproblem_loss_threshold == 0


@pytest.mark.parametrize("name", UPDATES)
def test_updates_of_chapter_3_are_the_source_s(name: str) -> None:
    schedule = load(name).schedule
    assert (schedule.target_switches, schedule.epochs) == UPDATES[name]
    assert schedule.update_every == "episode"


def test_initialisations_are_the_source_s() -> None:
    for name, numbers in INITIALISATIONS.items():
        initialisation = load(name).initialisation
        assert initialisation is not None
        assert (initialisation.demonstration_samples, initialisation.target_switches) == numbers
    assert load("reaching-ch3").initialisation is None  # both are published: the other by override
    initialised = load("reaching-ch3", *INITIALISE_REACHING).initialisation
    assert initialised is not None
    assert initialised.target_switches == 20


@pytest.mark.parametrize("name", IMITATIONS)
def test_imitation_of_chapter_4_is_the_source_s(name: str) -> None:
    preset = load(name)
    imitation, schedule = preset.imitation, preset.schedule
    assert imitation is not None
    numbers = (
        imitation.discriminator_epochs,
        imitation.generator_epochs,
        imitation.demonstration_samples,
    )
    assert numbers == IMITATIONS[name]
    # The schedule says the same of the generator: K epochs, with a switch after each.
    assert (schedule.target_switches, schedule.epochs) == (imitation.generator_epochs, 1)


@pytest.mark.parametrize(
    ("name", "experiment", "panel"),
    [
        ("shirt-ch4-tuned", "table-4.5", "shirt"),
        ("trousers-ch4-tuned", "table-4.5", "trousers"),
        ("handkerchief-ch4-tuned", "figure-4.9", "60 actions, 8 iterations"),
    ],
)
def test_tuned_presets_are_what_the_reproduction_shows(
    name: str, experiment: str, panel: str
) -> None:
    shown = find_experiment(experiment)
    (found,) = (each for each in shown.panels if each.title == panel)
    planned = shown.plan(found, BID, found.first_seed).preset
    preset = load(name)
    assert preset == replace(planned, name=preset.name, source=preset.source, seed=preset.seed)


@pytest.mark.parametrize("head", ["plain", "dueling-mean"])
@pytest.mark.parametrize(
    "name", [path.stem for path in PATHS if "ch3" in path.stem or "smoke" in path.stem]
)
def test_the_dqn_baselines_are_overrides(name: str, head: str) -> None:
    overrides = ("algorithm.method=dqn", "algorithm.sigma=0.0", f"algorithm.head={head}")
    preset = load(name, *overrides)
    assert preset.exploration is not None
    assert preset.exploration.epsilon(0) == 1.0
    assert preset.exploration.epsilon(preset.schedule.episodes) == pytest.approx(0.1)


@pytest.mark.parametrize("n_joints", [2, 5, 15, 25, 50])
def test_other_arms_are_overrides(n_joints: int) -> None:
    joints = f"task.options.n_joints={n_joints}"
    preset = load("reaching-ch3", joints, f"task.n_actions={5 * n_joints}")
    assert preset.network.n_actions == 5 * n_joints
