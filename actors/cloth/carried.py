"""Where hands really are while they carry, if something slower than a wish moves them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class CarriedPaths:
    """What hands do from closing to opening, and a robot's joints with them.

    Cloth keeps the offset to the hand that it had when the hand closed.
    """

    times_secs: NDArray[np.float64]
    """f64[K], K >= 2, rising from 0; between two rows everything goes straight."""

    positions_in_world: NDArray[np.float64]
    """f64[K, H, 3], metres."""

    turns_rad: NDArray[np.float64]
    """f64[K, H], how far each hand is turned around its axis."""

    joints_rad: NDArray[np.float64]
    """f64[K, 15], for a world in which the robot stands."""

    arms: tuple[Literal["left", "right"], ...]
    """Which arm is which hand."""

    def to_wire(self) -> dict[str, Any]:
        """Plain values, for another process."""
        return {
            "times": self.times_secs.tobytes(),
            "positions": self.positions_in_world.tobytes(),
            "turns": self.turns_rad.tobytes(),
            "joints": self.joints_rad.tobytes(),
            "arms": list(self.arms),
        }

    @classmethod
    def from_wire(cls, wire: Mapping[str, Any]) -> "CarriedPaths":
        """The inverse of `to_wire`."""
        times, n_hands = np.frombuffer(wire["times"]), len(wire["arms"])
        return cls(
            times,
            np.frombuffer(wire["positions"]).reshape(len(times), n_hands, 3),
            np.frombuffer(wire["turns"]).reshape(len(times), n_hands),
            np.frombuffer(wire["joints"]).reshape(len(times), -1),
            tuple(wire["arms"]),
        )

    def steps_secs(self, time_step_secs: float) -> NDArray[np.float64]:
        """Times f64[N] after each time step; the last one is the end."""
        n_steps = max(2, int(np.ceil(self.times_secs[-1] / time_step_secs)))
        steps = np.arange(1, n_steps + 1) * time_step_secs
        return np.asarray(np.minimum(steps, self.times_secs[-1]))

    def hands_at(self, times_secs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions and turns of all hands, f64[N, H, 4]."""
        rows = np.concatenate([self.positions_in_world, self.turns_rad[..., None]], axis=2)
        return interpolated(times_secs, self.times_secs, rows)

    def joints_at(self, times_secs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Joint angles f64[N, 15]."""
        return interpolated(times_secs, self.times_secs, self.joints_rad)


def interpolated(
    times_secs: NDArray[np.float64], known_secs: NDArray[np.float64], rows: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rows f64[N, ...] at times f64[N], straight between rows f64[K, ...] of known times."""
    after = np.clip(np.searchsorted(known_secs, times_secs), 1, len(known_secs) - 1)
    before = after - 1
    portion = (times_secs - known_secs[before]) / (known_secs[after] - known_secs[before])
    portion = np.clip(portion, 0.0, 1.0).reshape(-1, *[1] * (rows.ndim - 1))
    return np.asarray(rows[before] + portion * (rows[after] - rows[before]))
