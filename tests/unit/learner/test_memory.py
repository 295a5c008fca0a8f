from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from broker_config.errors import MessageError, StorageError
from learner.memory import LocalMemory

SHAPE = (2, 3, 1)
ALL = torch.arange(100)


@dataclass
class NaiveMemory:
    """Keeps every sample with its own two pictures."""

    capacity: int
    samples: list[tuple[bytes, int, float, bytes, bool]] = field(default_factory=list)
    held: list[tuple[bytes, int, float, bytes, bool]] = field(default_factory=list)

    def add(self, observations, actions, rewards, terminated) -> None:
        last = len(actions) - 1
        for t, (action, reward) in enumerate(zip(actions, rewards, strict=True)):
            before, after = observations[t].tobytes(), observations[t + 1].tobytes()
            ended = terminated and t == last
            self.samples.append((before, int(action), float(reward), after, ended))
        self.samples = self.samples[-(self.capacity - len(self.held)) :]

    def hold(self) -> None:
        self.held, self.samples = self.samples, []


def trajectory(
    length: int, seed: int
) -> tuple[NDArray[np.uint8], NDArray[np.int32], NDArray[np.float32]]:
    generator = np.random.default_rng(seed)
    return (
        generator.integers(0, 256, (length + 1, *SHAPE), np.uint8),
        generator.integers(0, 5, length).astype(np.int32),
        generator.normal(size=length).astype(np.float32),
    )


def contents(memory: LocalMemory) -> list[tuple[bytes, int, float, bytes, bool]]:
    batch = memory.minibatch(torch.arange(len(memory)))
    return [
        (
            batch.observations[i].numpy().tobytes(),
            int(batch.actions[i]),
            float(batch.rewards[i]),
            batch.next_observations[i].numpy().tobytes(),
            bool(batch.terminated[i]),
        )
        for i in range(len(memory))
    ]


def filled(capacity: int, lengths: list[int]) -> LocalMemory:
    memory = LocalMemory(capacity, SHAPE)
    for seed, length in enumerate(lengths):
        memory.add(*trajectory(length, seed), terminated=seed % 2 == 0)
    return memory


@given(
    st.integers(1, 12),
    st.lists(st.tuples(st.integers(1, 15), st.booleans(), st.booleans()), min_size=1, max_size=15),
)
def test_equals_a_naive_memory(capacity: int, plan: list[tuple[int, bool, bool]]) -> None:
    memory, naive = LocalMemory(capacity, SHAPE), NaiveMemory(capacity)
    for seed, (length, terminated, restores) in enumerate(plan):
        parts = trajectory(length, seed)
        memory.add(*parts, terminated=terminated)
        naive.add(*parts, terminated)
        if restores:
            state = memory.get_state()
            memory = LocalMemory(capacity, SHAPE)
            memory.set_state(state)
        assert contents(memory) == naive.samples
        assert torch.equal(memory.live_frames(0, memory.n_frames), memory.get_state()["frames"])


@given(
    st.integers(2, 14),
    st.lists(st.integers(1, 5), min_size=1, max_size=4),
    st.lists(st.tuples(st.integers(1, 15), st.booleans()), max_size=12),
)
def test_what_is_held_stays_while_others_age(
    capacity: int, demonstrated: list[int], plan: list[tuple[int, bool]]
) -> None:
    memory, naive = LocalMemory(capacity, SHAPE), NaiveMemory(capacity)
    for seed, length in enumerate(demonstrated):
        parts = trajectory(length, 1000 + seed)
        memory.add(*parts, terminated=False)
        naive.add(*parts, False)
    assume(len(memory) < capacity)
    memory.hold()
    naive.hold()
    address = memory.ring.data_ptr()
    for seed, (length, restores) in enumerate(plan):
        parts = trajectory(length, seed)
        memory.add(*parts, terminated=seed % 2 == 0)
        naive.add(*parts, seed % 2 == 0)
        state = memory.get_state()
        if restores:
            memory = LocalMemory(capacity, SHAPE)
            address = memory.ring.data_ptr()
            memory.set_state(state)
        assert contents(memory) == naive.held + naive.samples
        assert memory.n_held == len(naive.held)
        n = memory.n_frames
        parts_of_it = [memory.live_frames(start, start + 3) for start in range(0, n, 3)]
        assert torch.equal(torch.cat(parts_of_it), state["frames"])
        assert torch.equal(
            memory.states_after(), memory.minibatch(ALL[: len(memory)]).next_observations
        )
    assert memory.ring.data_ptr() == address


def test_refuses_to_hold_what_cannot_be_held() -> None:
    for memory, got in ((LocalMemory(5, SHAPE), "got 0, 0"), (filled(5, [5]), "got 5, 0")):
        with pytest.raises(MessageError, match=f"expected 1 to 4 samples to hold.*{got}"):
            memory.hold()
    memory = filled(9, [4])
    memory.hold()
    with pytest.raises(MessageError, match="got 4, 4 of them held"):
        memory.hold()
    memory.add(*trajectory(3, 0), terminated=False)
    state = memory.get_state()
    for n_held, message in ((0, "0 held"), (8, "8 held"), (2, "2 samples that end inside one")):
        with pytest.raises(StorageError, match=message):
            LocalMemory(9, SHAPE).set_state({**state, "held": torch.tensor(n_held)})
    with pytest.raises(StorageError, match="room for others"):
        LocalMemory(4, SHAPE).set_state({**filled(4, [4]).get_state(), "held": torch.tensor(4)})


def test_stores_each_picture_once() -> None:
    memory = filled(100, [30, 30, 30])
    assert (len(memory), memory.n_frames) == (90, 93)


def test_drops_single_samples_and_their_pictures() -> None:
    memory = filled(40, [30, 30])
    assert (len(memory), memory.n_frames) == (40, 42)
    assert memory.samples.positions.tolist() == [*range(10), *range(11, 41)]


def test_many_short_trajectories_fit() -> None:
    memory = filled(8, [1] * 50)
    assert (len(memory), memory.n_frames) == (8, 16)


def test_the_ring_stays_where_it_is() -> None:
    memory = LocalMemory(10, SHAPE)
    address = memory.ring.data_ptr()
    for seed in range(20):
        memory.add(*trajectory(7, seed), terminated=False)
    memory.set_state(memory.get_state())
    assert memory.ring.data_ptr() == address


def test_live_frames_come_in_parts() -> None:
    memory = filled(10, [7] * 9)
    n = memory.n_frames
    whole = memory.live_frames(0, n)
    parts = [memory.live_frames(start, start + 5) for start in range(0, n, 5)]
    assert torch.equal(torch.cat(parts), whole)
    assert len(whole) == n


def test_the_state_after_each_sample_is_the_next_one_of_its_minibatch() -> None:
    memory = filled(10, [7, 1, 2] * 3)
    everything = memory.minibatch(torch.arange(len(memory)))
    assert torch.equal(memory.states_after(), everything.next_observations)


def test_rewards_can_be_replaced() -> None:
    memory = filled(10, [7, 7])
    before = contents(memory)
    new = torch.arange(10, dtype=torch.float32)
    memory.replace_rewards(new)
    new.zero_()  # the memory has its own copy
    assert memory.samples.rewards.tolist() == list(range(10))
    assert [(s[0], s[1], s[3], s[4]) for s in contents(memory)] == [
        (s[0], s[1], s[3], s[4]) for s in before
    ]
    with pytest.raises(MessageError, match=r"float32 \[10\], one for each sample; got .* \[9\]"):
        memory.replace_rewards(torch.zeros(9))
    with pytest.raises(MessageError, match="finite"):
        memory.replace_rewards(torch.full((10,), float("nan")))


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        (0, np.zeros((5, *SHAPE), np.uint8), r"observations: expected uint8 \[4, 2, 3, 1\]"),
        (0, np.zeros((4, *SHAPE), np.float32), r"got float32 \[4, 2, 3, 1\]"),
        (1, np.zeros(3, np.int64), r"actions: expected int32 \[3\]; got int64"),
        (1, np.zeros(0, np.int32), "at least 1"),
        (2, np.zeros(2, np.float32), r"rewards: expected float32 \[3\]; got float32 \[2\]"),
        (2, np.array([0, np.inf, 0], np.float32), "finite"),
    ],
)
def test_refuses_a_wrong_trajectory(part: int, value: NDArray, message: str) -> None:
    memory = filled(10, [4])
    before = contents(memory)
    parts = list(trajectory(3, 0))
    parts[part] = value
    with pytest.raises(MessageError, match=message):
        memory.add(*parts, terminated=False)
    assert contents(memory) == before


def test_refuses_a_state_that_it_cannot_have() -> None:
    state = filled(10, [4, 4]).get_state()
    memory = LocalMemory(10, SHAPE)
    wrong = {
        "the parts": {name: state[name] for name in list(state)[1:]},
        "rewards torch.float32": {**state, "rewards": state["rewards"].double()},
        "frames torch.uint8": {**state, "frames": state["frames"][:, :1]},
        "with all their pictures": {**state, "frames": state["frames"][:-1]},
        "in order": {**state, "positions": state["positions"].flip(0)},
    }
    for message, changed in wrong.items():
        with pytest.raises(StorageError, match=message):
            memory.set_state(changed)
    with pytest.raises(StorageError, match="at most 7 samples"):
        LocalMemory(7, SHAPE).set_state(state)
    memory.set_state(state)
    assert len(memory) == 8


def test_an_empty_memory_has_a_state() -> None:
    memory = filled(10, [4])
    memory.set_state(LocalMemory(10, SHAPE).get_state())
    assert (len(memory), memory.n_frames) == (0, 0)


def test_refuses_to_hold_nothing() -> None:
    with pytest.raises(MessageError, match="at least 1"):
        LocalMemory(0, SHAPE)


def test_steps_see_changed_pictures_and_everybody_else_those_that_were_added() -> None:
    memory = LocalMemory(6, SHAPE)
    for seed in range(5):  # the ring has wrapped
        memory.add(*trajectory(4, seed), terminated=False)
    before, places = contents(memory), memory.ring_positions
    assert torch.equal(memory.learned_from[places], memory.ring[places])
    memory.change_pictures(lambda pictures: 255 - pictures)
    assert torch.equal(memory.learned_from[places], 255 - memory.ring[places])
    assert contents(memory) == before
