"""Where the robot stands at the table."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Stance:
    """The robot's waist in the table's world, and where its chest faces when it is not turned."""

    x_m: float
    y_m: float
    z_m: float
    """Above the table's top."""

    heading_rad: float
    """From the world's x, counter-clockwise seen from above."""

    @property
    def origin_in_world(self) -> NDArray[np.float64]:
        """The waist, f64[3], metres."""
        return np.array([self.x_m, self.y_m, self.z_m])

    @property
    def rotation(self) -> NDArray[np.float64]:
        """f64[3, 3], from the robot's frame to the world's."""
        cosine, sine = np.cos(self.heading_rad), np.sin(self.heading_rad)
        return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])

    def in_robot(self, points_in_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points f64[..., 3] of the world in the robot's frame."""
        return np.ascontiguousarray((points_in_world - self.origin_in_world) @ self.rotation)

    def in_world(self, points_in_robot: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points f64[..., 3] of the robot's frame in the world."""
        return np.asarray(points_in_robot @ self.rotation.T + self.origin_in_world)


STANCES: Final[Mapping[str, Stance]] = MappingProxyType(
    {
        "front": Stance(0.0, -0.32, 0.05, np.pi / 2),
        "left": Stance(-0.36 * np.cos(np.pi / 6), -0.18, 0.08, np.pi / 6),
    }
)
"""By name. At the picture's lower side, looking up it; and at its left side, 30 degrees below."""


def check_stance(name: str) -> None:
    """Check a name.

    Raises:
        ValueError: there is no such stance.
    """
    if name not in STANCES:
        raise ValueError(
            f"robot_stance: expected one of {', '.join(STANCES)}; got {name!r}; name one of them"
        )
