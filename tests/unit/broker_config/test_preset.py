"""Presets: read strictly, compared by digest."""

import dataclasses

import pytest

from broker_config.errors import PresetError
from broker_config.preset import preset_from_json, preset_from_toml, with_seed

TOML = """
name = "reaching"
source = "table 3.1"
seed = 1

[task]
environment = "clothbus/Reaching-v0"
horizon = 30
observation_shape = [84, 84, 1]
n_actions = 10
options = { joints = 2 }

[algorithm]
method = "edpn"
head = "dueling-exact"
eta = 2
sigma = 0.5
gamma = 0.95

[schedule]
iterations = 4
episodes_per_iteration = 5
memory_samples = 450
update_every = "episode"
target_switches = 2
epochs = 80
minibatch_size = 32

[optimiser]
name = "adam"
learning_rate = 2.5e-4
epsilon = 1e-8
"""


def test_a_preset_survives_json_with_its_digest():
    preset = preset_from_toml(TOML)
    again = preset_from_json(preset.to_json())
    assert again == preset
    assert again.digest == preset.digest
    assert preset.task.options == {"joints": 2}


def test_the_digest_stays_from_version_to_version():
    """Runs are named by it: a value that is added must be left out where it is at its default."""
    digest = "0ad33147eb80bad91540228176d36a08094350c3dfb38ee2fed1f78f1184a0b4"
    assert preset_from_toml(TOML).digest == digest


def test_the_digest_differs_with_every_value():
    preset = preset_from_toml(TOML)
    others = [
        with_seed(preset, 2),
        dataclasses.replace(preset, name="other"),
        preset_from_toml(TOML, ["schedule.epochs=81"]),
        preset_from_toml(TOML, ["task.options.joints=3"]),
    ]
    assert len({preset.digest, *(other.digest for other in others)}) == 5
    assert with_seed(preset, 1).digest == preset.digest


def test_derived_temperatures_and_network():
    algorithm = preset_from_toml(TOML).algorithm
    assert (algorithm.beta, algorithm.alpha) == (1.0, 0.5)
    network = preset_from_toml(TOML).network
    assert (network.observation_shape, network.n_actions, network.beta) == ((84, 84, 1), 10, 1.0)


def test_versions_that_tickets_act_on():
    by_episode = preset_from_toml(TOML, ["schedule.policy_lag=1"]).schedule
    assert [by_episode.policy_version(ticket) for ticket in range(4)] == [0, 0, 1, 2]
    assert all(by_episode.updates_after(ticket) for ticket in range(4))
    by_iteration = preset_from_toml(TOML, ['schedule.update_every="iteration"']).schedule
    assert [by_iteration.policy_version(ticket) for ticket in (0, 4, 5, 9, 10)] == [0, 0, 1, 1, 2]
    assert [ticket for ticket in range(10) if by_iteration.updates_after(ticket)] == [4, 9]
    assert by_iteration.episodes == 20


@pytest.mark.parametrize("update_every", ["episode", "iteration"])
def test_the_versions_that_are_kept_end_the_iterations(update_every):
    schedule = preset_from_toml(TOML, [f"schedule.update_every={update_every}"]).schedule
    versions = schedule.iteration_versions()
    assert versions == ((0, 5, 10, 15, 20) if update_every == "episode" else (0, 1, 2, 3, 4))
    assert [schedule.episodes_before(version) for version in versions] == [0, 5, 10, 15, 20]
    assert all(schedule.updates_before(schedule.episodes_before(it)) == it for it in versions)


def test_exploration_falls_linearly():
    overrides = [
        "algorithm.method=dqn",
        "algorithm.sigma=0",
        "algorithm.head=plain",
        "exploration.epsilon_start=1.0",
        "exploration.epsilon_end=0.2",
        "exploration.decay_episodes=4",
    ]
    exploration = preset_from_toml(TOML, overrides).exploration
    expected = [1.0, 0.8, 0.6, 0.4, 0.2, 0.2]
    assert [exploration.epsilon(ticket) for ticket in range(6)] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("schedule.epochs=0", "schedule.epochs: expected at least 1; got 0"),
        ("schedule.epoch=3", "got also epoch"),
        ("schedule.epochs=many", "preset.schedule.epochs: expected int; got str 'many'"),
        ("algorithm.eta=0", "algorithm.eta: expected a finite positive number"),
        ("algorithm.eta=inf", "algorithm.eta"),
        ("algorithm.gamma=1.0", "algorithm.gamma"),
        ("algorithm.method=dpn", "algorithm.sigma: expected 0 for dpn"),
        ("algorithm.head=dueling-mean", "algorithm.head"),
        ("task.n_actions=1", "n_actions: expected at least 2"),
        ("task.horizon=0", "task.horizon"),
        ("seed=-1", "seed: expected a number"),
        ("seed.x=1", "seed is a value, not a table"),
        ("seed", "expected KEY=VALUE"),
        ("optimiser.learning_rate=0", "optimiser.learning_rate"),
    ],
)
def test_a_wrong_value_is_named(override, text):
    with pytest.raises(PresetError, match=text):
        preset_from_toml(TOML, [override])


def test_text_that_is_no_preset():
    with pytest.raises(PresetError):
        preset_from_toml("not toml")
    with pytest.raises(PresetError, match="preset: "):
        preset_from_json("{")
    with pytest.raises(PresetError, match="name"):
        preset_from_json("{}")
