import dataclasses
import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from broker_config.errors import MessageError, StorageError
from broker_config.preset import (
    AlgorithmPreset,
    AugmentationPreset,
    ExplorationPreset,
    InitialisationPreset,
    OptimiserPreset,
    Preset,
    SchedulePreset,
    TaskPreset,
)
from learner.steps.compute import Compute
from learner.steps.eager_steps import EagerSteps
from learner.steps.graphed_steps import GraphedSteps
from learner.teaching_signal import soft_value
from learner.trainer import Trainer, TrainerState

N_ACTIONS = 4
PRESET = Preset(
    name="tiny",
    source="test",
    seed=3,
    task=TaskPreset("clothbus/None-v0", 6, (36, 36, 1), N_ACTIONS),
    algorithm=AlgorithmPreset("dpn", "plain", eta=1.0, sigma=0.0, gamma=0.9),
    schedule=SchedulePreset(
        iterations=2,
        episodes_per_iteration=2,
        memory_samples=20,
        update_every="episode",
        target_switches=2,
        epochs=3,
        minibatch_size=8,
    ),
    optimiser=OptimiserPreset("adam", 2.5e-4, 1e-8),
    exploration=ExplorationPreset(1.0, 0.1, 4),
    initialisation=InitialisationPreset(6, 3),
)
AUGMENTATION = AugmentationPreset(turn_deg=20.0, shift_px=3)


def preset_with(**changes: object) -> Preset:
    """The tiny preset with some values of its tables replaced, named as `table__key`."""
    preset = PRESET
    for path, value in changes.items():
        table, _, key = path.partition("__")
        part = replace(getattr(preset, table), **{key: value})
        preset = replace(preset, **{table: part})
    return preset


def add_trajectory(trainer: Trainer, seed: int, length: int = 6, terminated: bool = False) -> None:
    generator = np.random.default_rng(seed)
    trainer.add(
        generator.integers(0, 256, (length + 1, 36, 36, 1), np.uint8),
        generator.integers(0, N_ACTIONS, length).astype(np.int32),
        generator.normal(size=length).astype(np.float32),
        terminated=terminated,
    )


def trained(preset: Preset, n_updates: int = 2) -> Trainer:
    trainer = Trainer(preset)
    for seed in range(n_updates):
        add_trajectory(trainer, seed, terminated=seed % 2 == 1)
        add_trajectory(trainer, 100 + seed)
        trainer.update()
    return trainer


def same_state(a: TrainerState, b: TrainerState) -> bool:
    assert a.tensors.keys() == b.tensors.keys()
    equal = all(torch.equal(a.tensors[name], b.tensors[name]) for name in a.tensors)
    return equal and a.counters == b.counters


@pytest.mark.parametrize("head", ["plain", "dueling-exact", "dueling-penalty"])
def test_edpn_with_sigma_zero_is_dpn_bit_for_bit(head: str) -> None:
    dpn = preset_with(algorithm__head=head)
    edpn = replace(dpn, algorithm=replace(dpn.algorithm, method="edpn"))
    assert same_state(trained(dpn).get_state(), trained(edpn).get_state())


def test_causal_entropy_changes_the_result() -> None:
    edpn = AlgorithmPreset("edpn", "plain", eta=1.0, sigma=0.05, gamma=0.9)
    changed = trained(replace(PRESET, algorithm=edpn)).get_state()
    assert not same_state(changed, trained(PRESET).get_state())


def test_double_dqn_is_dqn_until_the_network_prefers_other_actions() -> None:
    """With one epoch the network is still the target network when it chooses."""
    dqn = preset_with(algorithm__method="dqn", schedule__epochs=1)
    double = preset_with(algorithm__method="double-dqn", schedule__epochs=1)
    assert same_state(trained(double).get_state(), trained(dqn).get_state())
    longer = {"schedule__epochs": 30, "optimiser__learning_rate": 1e-2}
    dqn = preset_with(algorithm__method="dqn", **longer)
    double = preset_with(algorithm__method="double-dqn", **longer)
    assert not same_state(trained(double).get_state(), trained(dqn).get_state())


def test_munchausen_dqn_is_edpn_where_nothing_is_unlikely_enough_to_be_clipped() -> None:
    """At a low temperature no log policy reaches the bound."""
    temperatures = {"algorithm__eta": 40.0, "algorithm__sigma": 0.003}
    munchausen = preset_with(algorithm__method="munchausen-dqn", **temperatures)
    edpn = preset_with(algorithm__method="edpn", **temperatures)
    signals = []
    for preset in (munchausen, edpn):
        trainer = Trainer(preset)
        with torch.no_grad():  # the same network, whatever it starts from
            for parameter in trainer._network.parameters():
                parameter.copy_(torch.linspace(-0.01, 0.01, parameter.numel()).view_as(parameter))
        add_trajectory(trainer, 0)
        signals.append(trainer._assess().teaching_signals)
    assert torch.equal(*signals)


def test_the_same_calls_give_the_same_state() -> None:
    assert same_state(trained(PRESET).get_state(), trained(PRESET).get_state())
    other_seed = replace(PRESET, seed=4)
    assert not same_state(trained(other_seed).get_state(), trained(PRESET).get_state())


@pytest.mark.parametrize("optimiser", ["adam", "rmsprop"])
def test_goes_on_bit_identically_from_its_saved_state(optimiser: str) -> None:
    preset = preset_with(optimiser__name=optimiser, algorithm__head="dueling-exact")
    check_goes_on(preset)
    check_goes_on(replace(preset, augmentation=AUGMENTATION))


def check_goes_on(preset: Preset) -> None:
    trainer = trained(preset)
    state = trainer.get_state()
    resumed = Trainer(replace(preset, seed=99))  # whatever it drew by itself is overwritten
    resumed.set_state(state)
    assert same_state(resumed.get_state(), state)
    for each in (trainer, resumed):
        add_trajectory(each, 7)
        each.update()
    assert same_state(resumed.get_state(), trainer.get_state())
    assert resumed.weights_bytes() == trainer.weights_bytes()
    assert not same_state(resumed.get_state(), state)


def test_a_state_is_a_copy() -> None:
    trainer = trained(PRESET, 1)
    state = trainer.get_state()
    kept = {name: part.clone() for name, part in state.tensors.items()}
    weights = trainer.weights()
    before = {name: part.clone() for name, part in weights.items()}
    add_trajectory(trainer, 5)
    trainer.update()
    assert all(torch.equal(kept[name], part) for name, part in state.tensors.items())
    assert all(torch.equal(before[name], part) for name, part in weights.items())


def test_refuses_a_state_of_another_preset() -> None:
    state = trained(PRESET, 1).get_state()
    with pytest.raises(StorageError, match=r"a difference in network\.value_hidden"):
        Trainer(preset_with(algorithm__head="dueling-exact")).set_state(state)
    with pytest.raises(StorageError, match="at most 5 samples"):
        Trainer(preset_with(schedule__memory_samples=5)).set_state(state)
    with pytest.raises(StorageError, match="expected shuffling, updates, target_switches"):
        Trainer(PRESET).set_state(TrainerState(state.tensors, {"updates": 1}))


def test_learns_the_values_of_a_memory_that_stays() -> None:
    """Many target switches on one terminated transition pair: V becomes what it earns."""
    preset = preset_with(
        schedule__target_switches=30, schedule__epochs=12, optimiser__learning_rate=1e-3
    )
    trainer = Trainer(preset)
    observations = np.zeros((3, 36, 36, 1), np.uint8)
    observations[1] = 120
    for action in range(N_ACTIONS):  # every action does the same: 1 now and 2 then
        actions = np.full(2, action, np.int32)
        trainer.add(observations, actions, np.array([1.0, 2.0], np.float32), terminated=True)
    report = trainer.update()
    network = trainer._network
    with torch.no_grad():
        values = soft_value(network(torch.from_numpy(observations[:2])), 1.0)
    torch.testing.assert_close(values, torch.tensor([1 + 0.9 * 2.0, 2.0]), atol=0.1, rtol=0)
    assert report.mean_value == pytest.approx(values.mean().item(), abs=0.01)
    assert report.losses[-1] < 0.01 < report.losses[0]
    assert report.bellman_error < 0.5


def test_dqn_learns_in_the_same_loop() -> None:
    preset = preset_with(
        schedule__target_switches=30, schedule__epochs=12, optimiser__learning_rate=1e-3
    )
    preset = replace(preset, algorithm=replace(preset.algorithm, method="dqn"))
    trainer = Trainer(preset)
    observations = np.zeros((3, 36, 36, 1), np.uint8)
    observations[1] = 120
    for action in range(N_ACTIONS):
        rewards = np.array([float(action), -float(action)], np.float32)
        trainer.add(observations, np.full(2, action, np.int32), rewards, terminated=True)
    trainer.update()
    with torch.no_grad():
        outputs = trainer._network(torch.from_numpy(observations[:2]))
    # After the second picture action 0 is best and earns 0, whatever was done before.
    expected = torch.tensor([[0.0, 1.0, 2.0, 3.0], [0.0, -1.0, -2.0, -3.0]])
    torch.testing.assert_close(outputs, expected, atol=0.25, rtol=0)


def test_counts_gradient_steps() -> None:
    trainer = Trainer(PRESET)
    add_trajectory(trainer, 0)  # 6 samples: one smaller minibatch
    report = trainer.update()
    assert report.gradient_steps == 2 * 3 * 1
    add_trajectory(trainer, 1)
    add_trajectory(trainer, 2)  # 18 samples, minibatches of 8: 2
    report = trainer.update(target_switches=4)
    assert report.gradient_steps == 4 * 3 * 2
    assert len(report.losses) == 4
    assert trainer.gradient_steps == 6 + 24
    assert report.secs > 0


def test_every_epoch_shuffles_anew_and_visits_no_sample_twice() -> None:
    trainer = Trainer(PRESET)
    seen: list[torch.Tensor] = []

    class Spy:
        def run(self, batches: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
            seen.append(batches)
            return torch.zeros(len(batches))

    trainer._steps = Spy()
    for seed in range(3):
        add_trajectory(trainer, seed)
    trainer.update(1)
    epochs = seen[0].view(3, 16).tolist()
    assert all(len(set(epoch)) == 16 and max(epoch) < 18 for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]


def test_initialise_makes_the_preset_s_switches() -> None:
    trainer = Trainer(PRESET)
    add_trajectory(trainer, 0)
    assert len(trainer.initialise().losses) == 3
    with pytest.raises(MessageError, match=r"expected an \[initialisation\] table"):
        Trainer(replace(PRESET, initialisation=None)).initialise()


def test_a_sub_problem_ends_early_below_the_threshold() -> None:
    trainer = Trainer(preset_with(schedule__subproblem_loss_threshold=1e9))
    add_trajectory(trainer, 0)
    assert trainer.update().gradient_steps == 2  # one epoch in each sub-problem
    trainer = Trainer(preset_with(schedule__subproblem_loss_threshold=1e-30))
    add_trajectory(trainer, 0)
    assert trainer.update().gradient_steps == 2 * 3


def test_a_threshold_that_never_ends_anything_changes_nothing() -> None:
    without = trained(PRESET).get_state()
    assert same_state(
        trained(preset_with(schedule__subproblem_loss_threshold=1e-30)).get_state(), without
    )


def test_reports_chance_at_the_start() -> None:
    trainer = Trainer(preset_with(optimiser__learning_rate=1e-12))
    add_trajectory(trainer, 0)
    report = trainer.update()
    assert report.mean_entropy == pytest.approx(np.log(N_ACTIONS), abs=0.01)
    assert abs(report.mean_value) < 0.2


def test_refuses_what_it_cannot_do() -> None:
    trainer = Trainer(PRESET)
    with pytest.raises(MessageError, match="got none; add trajectories"):
        trainer.update()
    add_trajectory(trainer, 0)
    with pytest.raises(MessageError, match="target_switches: expected at least 1; got 0"):
        trainer.update(0)
    with pytest.raises(MessageError, match="actions: expected 0 to 3; got 4"):
        trainer.add(
            np.zeros((2, 36, 36, 1), np.uint8),
            np.array([4], np.int32),
            np.zeros(1, np.float32),
            terminated=False,
        )


@pytest.mark.parametrize("optimiser", ["adam", "rmsprop"])
def test_the_program_of_the_cuda_graph_makes_the_same_steps(optimiser: str) -> None:
    """The program that a GPU records, run as it is on the CPU: bit for bit the eager steps."""
    preset = preset_with(optimiser__name=optimiser, schedule__epochs=10)
    check_graphs(preset)
    check_graphs(replace(preset, augmentation=AUGMENTATION))


def check_graphs(preset: Preset) -> None:
    eager, graphed = (Trainer(preset, Compute(path="reference")) for _ in range(2))
    assert isinstance(eager._steps, EagerSteps)
    graphed._steps = GraphedSteps(
        graphed._network, graphed._optimiser, graphed._memory, record=run_twice_then_repeat
    )
    for seed in range(5):  # the ring wraps, and two sizes of minibatch occur
        reports = []
        for trainer in (eager, graphed):
            add_trajectory(trainer, seed)
            reports.append(trainer.update())
        assert reports[0].losses == reports[1].losses
    assert same_state(eager.get_state(), graphed.get_state())
    resumed = eager.get_state()
    graphed.set_state(resumed)
    assert same_state(graphed.get_state(), resumed)


def run_twice_then_repeat(program):
    """As recording does: the program runs before it is repeated."""
    program()
    program()
    return program


@pytest.mark.parametrize("path", ["reference", "winograd", "winograd-bf16", "graphs"])
def test_steps_are_made_from_the_changed_pictures(path: str) -> None:
    """As from a memory to which those were added."""
    compute = Compute(path="reference" if path == "graphs" else path)  # type: ignore[arg-type]
    changed, inverted = (Trainer(PRESET, compute) for _ in range(2))
    for trainer in (changed, inverted):
        if path == "graphs":
            trainer._steps = GraphedSteps(
                trainer._network, trainer._optimiser, trainer._memory, record=run_twice_then_repeat
            )
        add_trajectory(trainer, 0)
    inverted.memory.ring[:] = 255 - inverted.memory.ring
    changed.memory.change_pictures(lambda pictures: 255 - pictures)
    before = changed.weights_bytes()
    for trainer in (changed, inverted):
        trainer._steps.run(torch.tensor([[3, 0], [5, 1]]), torch.arange(6.0))
    assert changed.weights_bytes() == inverted.weights_bytes() != before


def test_what_is_taught_is_computed_on_pictures_as_they_are() -> None:
    plain, changing = Trainer(PRESET), Trainer(replace(PRESET, augmentation=AUGMENTATION))
    for trainer in (plain, changing):
        add_trajectory(trainer, 0)
    changing.memory.change_pictures(torch.zeros_like)
    assert torch.equal(plain._assess().teaching_signals, changing._assess().teaching_signals)


def test_what_comes_after_the_horizon_counts_unless_the_preset_ends_there() -> None:
    for ends, length, counts in ((False, 6, True), (True, 6, False), (True, 5, True)):
        trainer = Trainer(preset_with(algorithm__ends_at_horizon=ends))
        add_trajectory(trainer, 0, length)
        assessment = trainer._assess()
        samples = trainer.memory.samples
        after = assessment.bellman_targets - samples.rewards
        assert (after[-1] != 0) == counts
        assert (after[:-1] != 0).all()


def test_every_epoch_is_learned_from_other_pictures() -> None:
    trainer = Trainer(replace(PRESET, augmentation=AUGMENTATION))
    seen = []
    run = trainer._steps.run

    def watched(batches: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        seen.append(trainer.memory.learned_from.clone())
        return run(batches, targets)

    trainer._steps.run = watched  # type: ignore[method-assign]
    add_trajectory(trainer, 0)
    trainer.update(target_switches=2)
    assert len(seen) == 2 * PRESET.schedule.epochs
    for first, second in itertools.pairwise([trainer.memory.ring, *seen]):
        assert not torch.equal(first, second)


def test_a_state_of_pictures_that_were_not_changed_is_refused() -> None:
    changing = Trainer(replace(PRESET, augmentation=AUGMENTATION))
    with pytest.raises(StorageError, match=r"expected shuffling, augmenting, .* got shuffling, "):
        changing.set_state(trained(PRESET, 1).get_state())


def test_reports_are_plain_numbers() -> None:
    trainer = Trainer(PRESET)
    add_trajectory(trainer, 0)
    values = dataclasses.asdict(trainer.update())
    assert {type(value) for value in values.values()} == {float, int, tuple}
