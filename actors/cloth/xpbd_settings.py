"""The numbers of the XPBD cloth."""

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class XpbdSettings:
    """Material and solver. Compliances are inverse stiffnesses, for vertices of mass 1."""

    substeps_per_sec: int = 600
    """Each substep solves every constraint once: more of them make a stiffer and safer cloth."""

    stretch_compliance: float = 0.0
    """Along the threads: none gives."""

    shear_compliance: float = 1e-7
    """Along the diagonals."""

    bending_compliance: float = 1e-5
    """Between vertices two apart; larger is softer."""

    thickness_cells: float = 0.8
    """Distance that layers keep, over the mesh's spacing. Below 0.7 layers pass through gaps."""

    table_friction: float = 0.9
    layer_friction: float = 0.5

    damping_per_sec: float = 12.0
    """Portion of its velocity that the cloth loses in a second, for small portions: to the air, and
    to itself, which no other term does."""

    fastest_m_per_s: float = 2.0
    """Velocities are cut to this: what is grasped moves at half of it."""

    rest_speed_m_per_s: float = 0.05
    """Cloth whose every vertex is slower has come to rest."""

    longest_settling_secs: float = 0.3
    """Cloth that still creeps after so long is left as it is."""

    def __post_init__(self) -> None:
        """Check each number.

        Raises:
            ValueError: a number is negative or not finite, or one is 0 that must not be.
        """
        may_be_zero = {"stretch_compliance", "shear_compliance", "bending_compliance"}
        may_be_zero |= {"table_friction", "layer_friction", "damping_per_sec"}
        for setting in fields(self):
            value = getattr(self, setting.name)
            least = "0 or more" if setting.name in may_be_zero else "more than 0"
            is_right = 0.0 < value < np.inf or (value == 0.0 and setting.name in may_be_zero)
            if not is_right:
                raise ValueError(
                    f"XpbdSettings.{setting.name}: expected a finite number, {least}; got {value}; "
                    f"the default is {setting.default}"
                )
