"""The local memory D: the newest E samples, each picture stored once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from broker_config.errors import MessageError, StorageError

_CHANGED_AT_ONCE = 64
"""Pictures; what a change draws for each depends on it."""


@dataclass(frozen=True)
class Samples:
    """All samples of the memory, oldest first, on the memory's device.

    Observations are named by their position in `LocalMemory.live_frames`; the successor of a
    sample's observation is always the next one.
    """

    positions: Tensor
    """Of s, i64[n]; s' is at the position after it."""
    actions: Tensor
    """i64[n]."""
    rewards: Tensor
    """f32[n]."""
    terminated: Tensor
    """bool[n]."""


@dataclass(frozen=True)
class Minibatch:
    """Some samples, with their pictures."""

    observations: Tensor
    """u8[B, H, W, C]."""
    actions: Tensor
    """i64[B]."""
    rewards: Tensor
    """f32[B]."""
    next_observations: Tensor
    """u8[B, H, W, C]."""
    terminated: Tensor
    """bool[B]."""


class LocalMemory:
    """Keeps the newest `capacity` samples in the order in which they are added.

    A trajectory of T samples has T + 1 pictures, and each is stored once though it is the s' of one
    sample and the s of the next. Samples age one by one: a trajectory loses its oldest first.

    What is there when `hold` is called stays for good, as the oldest; others age beside it.

    The pictures lie in a ring that is allocated once. It has room for 2 * capacity of them, which
    is what is needed when every trajectory has a single sample; its address never changes. Pictures
    that stay lie at its beginning, and the others go round behind them.

    Attributes:
        learned_from: The ring as gradient steps see it: itself, or what `change_pictures` has made.
    """

    def __init__(
        self, capacity: int, observation_shape: tuple[int, int, int], device: str = "cpu"
    ) -> None:
        if capacity < 1:
            raise MessageError(f"memory: expected room for at least 1 sample; got {capacity}")
        self.capacity = capacity
        self.device = torch.device(device)
        self.ring = torch.zeros((2 * capacity, *observation_shape), dtype=torch.uint8).to(device)
        self.learned_from = self.ring
        self._first = 0  # where the oldest picture is, among the places that are gone round in
        self._n_frames = 0
        self._n_held = 0
        self._held_frames = 0
        self._samples = Samples(
            torch.empty(0, dtype=torch.int64, device=device),
            torch.empty(0, dtype=torch.int64, device=device),
            torch.empty(0, dtype=torch.float32, device=device),
            torch.empty(0, dtype=torch.bool, device=device),
        )

    def __len__(self) -> int:
        return len(self._samples.rewards)

    @property
    def samples(self) -> Samples:
        """All samples, oldest first."""
        return self._samples

    @property
    def ring_positions(self) -> Tensor:
        """Where in `ring` each sample's s is, i64[n]."""
        return self._places(self._samples.positions)

    def live_frames(self, start: int, stop: int) -> Tensor:
        """Pictures start...stop-1 of those in use, oldest first, u8[stop - start, H, W, C]."""
        held, stop = self._held_frames, min(stop, self._n_frames)
        if stop <= held and start < held:
            return self.ring[start:stop]
        ageing = self._ageing_frames(max(start - held, 0), stop - held)
        return torch.cat((self.ring[start:held], ageing)) if start < held else ageing

    def _ageing_frames(self, start: int, stop: int) -> Tensor:
        ring = self._ageing_ring
        first, last, size = self._first + start, self._first + stop, len(ring)
        if first < size < last:
            return torch.cat((ring[first:], ring[: last - size]))
        wrapped = size if first >= size else 0
        return ring[first - wrapped : last - wrapped]

    @property
    def n_held(self) -> int:
        """Samples that stay for good: the oldest."""
        return self._n_held

    def hold(self) -> None:
        """Keeps all samples that are there now for good; only those to come will age.

        Raises:
            MessageError: There are none, some are held already, or there is no room for others.
        """
        n_samples = len(self)
        if self._n_held or not 0 < n_samples < self.capacity:
            raise MessageError(
                f"memory: expected 1 to {self.capacity - 1} samples to hold, and none held before; "
                f"got {n_samples}, {self._n_held} of them held; hold once, and fewer than fit"
            )
        self.ring[: self._n_frames] = self.live_frames(0, self._n_frames).clone()
        self._first, self._n_held, self._held_frames = 0, n_samples, self._n_frames

    @property
    def n_frames(self) -> int:
        """Pictures in use."""
        return self._n_frames

    def add(
        self,
        observations: NDArray[np.uint8],
        actions: NDArray[np.int32],
        rewards: NDArray[np.float32],
        terminated: bool,
    ) -> None:
        """Adds a trajectory; the oldest that age go where more than `capacity` would be kept.

        Args:
            observations: u8[T+1, H, W, C]; T is at least 1.
            actions: i32[T].
            rewards: f32[T], finite.
            terminated: Whether the last transition ended the task. A truncation is no termination.

        Raises:
            MessageError: A shape or dtype is another, or a reward is not finite.
        """
        self._check_trajectory(observations, actions, rewards)
        n_new = min(len(actions), self.capacity - self._n_held)
        self._drop_oldest(max(0, len(self) + n_new - self.capacity))
        ends = torch.zeros(n_new, dtype=torch.bool)
        ends[-1] = terminated
        self._append_samples(
            Samples(
                torch.arange(self._n_frames, self._n_frames + n_new),
                torch.tensor(actions[-n_new:], dtype=torch.int64),
                torch.tensor(rewards[-n_new:]),
                ends,
            )
        )
        self._append_frames(torch.tensor(observations[-n_new - 1 :]))

    def minibatch(self, indices: Tensor) -> Minibatch:
        """The samples with these indices (0 is the oldest), i64[B]."""
        samples, here = self._samples, self._samples.positions[indices]
        return Minibatch(
            self.ring[self._places(here)],
            samples.actions[indices],
            samples.rewards[indices],
            self.ring[self._places(here + 1)],
            samples.terminated[indices],
        )

    def states_after(self) -> Tensor:
        """The picture after each sample, u8[n, H, W, C], oldest first."""
        return self.ring[self._places(self._samples.positions + 1)]

    def change_pictures(self, change: Callable[[Tensor], Tensor]) -> None:
        """Has gradient steps see every sample's picture changed, until it is called again.

        Args:
            change: Takes and gives u8[B, H, W, C].
        """
        if self.learned_from is self.ring:
            self.learned_from = torch.zeros_like(self.ring)
        for places in torch.split(self.ring_positions, _CHANGED_AT_ONCE):
            self.learned_from[places] = change(self.ring[places])

    def replace_rewards(self, rewards: Tensor) -> None:
        """Gives every sample a new reward, oldest first: Algorithm 4 labels anew.

        Args:
            rewards: f32[n], finite.

        Raises:
            MessageError: The rewards are not as many as the samples, or not finite float32.
        """
        if rewards.shape != (len(self),) or rewards.dtype != torch.float32:
            raise MessageError(
                f"rewards: expected float32 [{len(self)}], one for each sample; got "
                f"{rewards.dtype} {list(rewards.shape)}"
            )
        if not torch.isfinite(rewards).all():
            raise MessageError("rewards: expected finite numbers; got some that are not")
        self._samples = Samples(
            self._samples.positions,
            self._samples.actions,
            rewards.to(self.device, copy=True),
            self._samples.terminated,
        )

    def get_state(self) -> dict[str, Tensor]:
        """Everything that `set_state` needs, as tensors on the CPU."""
        held = {"held": torch.tensor(self._n_held)} if self._n_held else {}
        return {
            **held,
            "frames": self.live_frames(0, self._n_frames).cpu().clone(),
            "positions": self._samples.positions.cpu(),
            "actions": self._samples.actions.cpu(),
            "rewards": self._samples.rewards.cpu(),
            "terminated": self._samples.terminated.cpu(),
        }

    def set_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes back to what `get_state` gave; the samples and their order are exactly those.

        Raises:
            StorageError: The state is not one of a memory like this.
        """
        self.check_valid(state)
        self._first, self._n_frames = 0, len(state["frames"])
        self._n_held = int(state["held"]) if "held" in state else 0
        self._held_frames = int(state["positions"][self._n_held - 1]) + 2 if self._n_held else 0
        self.ring[: self._n_frames] = state["frames"].to(self.device)
        self._samples = Samples(
            *(state[name].to(self.device, copy=True) for name in Samples.__dataclass_fields__)
        )

    def check_valid(self, state: Mapping[str, Tensor]) -> None:
        """Refuses a state that no memory like this can have.

        Raises:
            StorageError: It says which part is wrong.
        """
        n_samples = len(state["rewards"]) if "rewards" in state else 0
        expected = {
            "frames": (torch.uint8, (None, *self.ring.shape[1:])),
            "positions": (torch.int64, (n_samples,)),
            "actions": (torch.int64, (n_samples,)),
            "rewards": (torch.float32, (n_samples,)),
            "terminated": (torch.bool, (n_samples,)),
        }
        if "held" in state:
            expected["held"] = torch.int64, ()
        if state.keys() != expected.keys():
            raise _invalid(f"the parts {sorted(expected)}", f"{sorted(state)}")
        for name, (dtype, shape) in expected.items():
            got = state[name]
            fits = len(got.shape) == len(shape) and all(
                rule in (None, size) for rule, size in zip(shape, got.shape, strict=True)
            )
            if not fits or got.dtype != dtype:
                raise _invalid(f"{name} {dtype} {shape}", f"{got.dtype} {list(got.shape)}")
        self._check_positions(state["positions"], len(state["frames"]))
        if "held" in state:
            self._check_held(int(state["held"]), state["positions"])

    def _check_positions(self, positions: Tensor, n_frames: int) -> None:
        if len(positions) > self.capacity:
            raise _invalid(f"at most {self.capacity} samples", str(len(positions)))
        if len(positions) == 0:
            if n_frames:
                raise _invalid("no pictures without samples", str(n_frames))
            return
        steps = positions.diff()
        # Neighbours are one picture apart inside a trajectory and two between trajectories.
        in_order = positions[0] == 0 and bool(((steps == 1) | (steps == 2)).all())
        if not in_order or n_frames != int(positions[-1]) + 2:
            raise _invalid("samples in order, with all their pictures", "positions that are not")

    def _check_held(self, n_held: int, positions: Tensor) -> None:
        if not 1 <= n_held <= min(len(positions), self.capacity - 1):
            raise _invalid("to hold some of its samples, and room for others", f"{n_held} held")
        ageing = positions[n_held:]
        if len(ageing) and int(ageing[0]) != int(positions[n_held - 1]) + 2:
            raise _invalid("to hold whole trajectories", f"{n_held} samples that end inside one")

    def _check_trajectory(
        self,
        observations: NDArray[np.uint8],
        actions: NDArray[np.int32],
        rewards: NDArray[np.float32],
    ) -> None:
        T = len(actions)
        rules: dict[str, tuple[NDArray[Any], type, tuple[int, ...]]] = {
            "observations": (observations, np.uint8, (T + 1, *self.ring.shape[1:])),
            "actions": (actions, np.int32, (T,)),
            "rewards": (rewards, np.float32, (T,)),
        }
        if T < 1:
            raise MessageError("trajectory.actions: expected at least 1; got none")
        for name, (array, dtype, shape) in rules.items():
            if array.dtype != dtype or array.shape != shape:
                raise MessageError(
                    f"trajectory.{name}: expected {np.dtype(dtype)} {list(shape)}; got "
                    f"{array.dtype} {list(array.shape)}; actor and learner run different presets"
                )
        if not np.isfinite(rewards).all():
            raise MessageError("trajectory.rewards: expected finite numbers; got some that are not")

    @property
    def _ageing_ring(self) -> Tensor:
        """The places that are gone round in."""
        return self.ring[self._held_frames :]

    def _places(self, positions: Tensor) -> Tensor:
        """Where in `ring` the live pictures at these positions are, of the same shape."""
        held = self._held_frames
        behind = held + (positions - held + self._first) % (len(self.ring) - held)
        return torch.where(positions < held, positions, behind) if held else behind

    def _drop_oldest(self, n_dropped: int) -> None:
        """Drops so many of the samples that age, and the pictures that only they had."""
        if n_dropped == 0:
            return
        held, ageing = self._n_held, self._n_held + n_dropped
        kept = Samples(*(torch.cat((it[:held], it[ageing:])) for it in _parts(self._samples)))
        is_left = len(kept.positions) > held
        gone = (int(kept.positions[held]) if is_left else self._n_frames) - self._held_frames
        kept.positions[held:] -= gone
        self._first = (self._first + gone) % len(self._ageing_ring)
        self._n_frames -= gone
        self._samples = kept

    def _append_samples(self, new: Samples) -> None:
        pairs = zip(_parts(self._samples), _parts(new), strict=True)
        self._samples = Samples(*(torch.cat((old, part.to(self.device))) for old, part in pairs))

    def _append_frames(self, frames: Tensor) -> None:
        ring = self._ageing_ring
        start = (self._first + self._n_frames - self._held_frames) % len(ring)
        n_before_end = min(len(frames), len(ring) - start)
        ring[start : start + n_before_end] = frames[:n_before_end].to(self.device)
        ring[: len(frames) - n_before_end] = frames[n_before_end:].to(self.device)
        self._n_frames += len(frames)


def _parts(samples: Samples) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return samples.positions, samples.actions, samples.rewards, samples.terminated


def _invalid(rule: str, got: str) -> StorageError:
    return StorageError(
        f"memory state: expected {rule}; got {got}; the checkpoint belongs to another preset"
    )
