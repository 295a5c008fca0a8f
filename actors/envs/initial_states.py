"""The named states in which an episode may begin. Source: tables 4.3 and 4.5, as far as they say.

| name | how the garment lies |
|---|---|
| `flat` | spread out in the middle |
| `random` | after three random actions of the task |
| `rotated` | spread out, turned by 20 to 40 degrees either way |
| `shifted` | spread out, 4 to 6 cm off the middle |
| `creased` | spread out but for two creases |
| `folded_over` | with one end folded over to its middle |
| `crumpled` | picked up anywhere and dropped near the middle, 8 to 30 times |

**assumed**: all numbers. Each is drawn from the episode's seed, or taken from a file; see
`actors.envs.stored_states`.
"""

from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

InitialState = Literal["flat", "random", "rotated", "shifted", "creased", "folded_over", "crumpled"]
INITIAL_STATES: Final[tuple[InitialState, ...]] = get_args(InitialState)

RANDOM_ACTIONS: Final = 3
ROTATED_RAD: Final = (float(np.deg2rad(20.0)), float(np.deg2rad(40.0)))
SHIFTED_M: Final = (0.04, 0.06)


@dataclass(frozen=True)
class Pose:
    """Where a garment is spread out: turned around its middle, then shifted."""

    turn_rad: float = 0.0
    x_m: float = 0.0
    y_m: float = 0.0

    def placed(self, vertices_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Vertices f64[V, 3] of a mesh at rest, put there."""
        cosine, sine = np.cos(self.turn_rad), np.sin(self.turn_rad)
        placed = vertices_m.copy()
        placed[:, :2] = vertices_m[:, :2] @ np.array([[cosine, sine], [-sine, cosine]])
        placed[:, :2] += (self.x_m, self.y_m)
        return placed


def check_initial_state(name: str) -> None:
    """Check a name.

    Raises:
        ValueError: there is no such state.
    """
    if name not in INITIAL_STATES:
        raise ValueError(
            f"initial_state: expected one of {', '.join(INITIAL_STATES)}; got {name!r}; name one "
            "of them"
        )


def initial_pose(name: InitialState, random: np.random.Generator) -> Pose:
    """Where the garment is spread out before anything is done to it."""
    if name == "rotated":
        return Pose(turn_rad=random.choice([-1.0, 1.0]) * random.uniform(*ROTATED_RAD))
    if name == "shifted":
        direction, distance_m = random.uniform(-np.pi, np.pi), random.uniform(*SHIFTED_M)
        return Pose(0.0, distance_m * np.cos(direction), distance_m * np.sin(direction))
    return Pose()
