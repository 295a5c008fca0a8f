"""The numbers of PyBullet's cloth, apart from PyBullet itself.

With them a 12 x 12 handkerchief of 0.3 m survived hundreds of random actions without exploding.
Finer meshes need shorter time steps, because the springs are integrated explicitly.
"""

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class PyBulletSettings:
    """Numbers of the simulation; PyBullet gives units to some of them only."""

    time_step_secs: float = 1 / 400
    """At 1/240 the cloth exploded once in 200 actions, and an action took twice as long."""

    mass_kg: float = 0.05

    elastic_stiffness: float = 80.0
    """At 40, 5 of 100 random actions left an edge above 1.5 times its length; at 80, 6 of 487."""

    damping_stiffness: float = 0.1

    bending_stiffness: float = 1.0
    """A handkerchief; 0.5 is softer and suits garments."""

    friction: float = 0.5
    collision_margin_m: float = 0.003

    def __post_init__(self) -> None:
        """Check each number.

        Raises:
            ValueError: a number is not positive.
        """
        for setting in fields(self):
            value = getattr(self, setting.name)
            if not 0.0 < value < np.inf:
                raise ValueError(
                    f"PyBulletSettings.{setting.name}: expected a positive number; got {value}; "
                    f"the default is {setting.default}"
                )
