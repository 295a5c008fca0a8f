"""What may differ from one episode to the next: the garment, its material, the picture, luck."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np

from actors.cloth.camera import Camera
from actors.cloth.rasteriser import DAYLIGHT, ClothColours, Light, Rgb
from actors.envs.arguments import check_range, check_size

HELD_OUT_BEYOND = 1.5
"""Held-out sizes and materials lie between one and so many times the range."""


@dataclass(frozen=True)
class Conditions:
    """One episode's draw; the defaults change nothing."""

    size: float = 1.0
    """Every length of the garment is multiplied with it."""

    stiffness: float = 1.0
    """Resistance to bending is multiplied with it."""

    friction: float = 1.0
    shift_m: tuple[float, float] = (0.0, 0.0)
    turn_rad: float = 0.0
    creases: int = 0
    front: Rgb = (0, 0, 0)
    """Added to the front's colour, and so on."""

    back: Rgb = (0, 0, 0)
    table: Rgb = (0, 0, 0)
    light: Light = DAYLIGHT
    camera_shift_m: tuple[float, float] = (0.0, 0.0)
    camera_roll_rad: float = 0.0

    def recoloured(self, colours: ClothColours) -> ClothColours:
        """The colours of this episode."""
        return ClothColours(
            _added(colours.front, self.front),
            _added(colours.back, self.back),
            _added(colours.table, self.table),
        )

    def moved(self, camera: Camera) -> Camera:
        """The camera of this episode, which still looks at the table's middle."""
        x_m, y_m = self.camera_shift_m
        return replace(camera, x_m=x_m, y_m=y_m, roll_rad=self.camera_roll_rad)


@dataclass(frozen=True)
class Randomisation:
    """How far an episode's conditions may lie from the usual ones; the defaults are: not at all."""

    size: float = 0.0
    """Lengths differ by at most this portion."""

    stiffness: float = 0.0
    """The natural logarithm of the factor is at most this."""

    friction: float = 0.0
    """Differs by at most this portion."""

    shift_m: float = 0.0
    """The garment begins at most this far from the middle, along x and along y."""

    turn_rad: float = 0.0
    creases: int = 0
    """At most so many creases are made before the episode."""

    colours: float = 0.0
    """Each channel of each colour differs by at most this, of 255."""

    light: float = 0.0
    """Strength, ambient light and direction differ by at most this portion."""

    camera_m: float = 0.0
    """The camera is shifted by at most this, along x and along y."""

    camera_roll_rad: float = 0.0
    noise: float = 0.0
    """Standard deviation of the sensor's noise, of 255."""

    missed_grasps: float = 0.0
    """Probability with which a gripper closes on nothing."""

    held_out: bool = False
    """Sizes and materials from beyond the range, up to `HELD_OUT_BEYOND` times as far: for tests of
    generalisation."""

    def __post_init__(self) -> None:
        """Check each number.

        Raises:
            ValueError: a number is out of its range.
        """
        check_size("randomisation.creases", self.creases, least=0)
        for name, most in _MOST.items():
            check_range(f"randomisation.{name}", getattr(self, name), 0.0, most)

    def draw(self, random: np.random.Generator) -> Conditions:
        """The conditions of one episode; as many numbers are drawn whatever the ranges are."""
        size, stiffness, friction = (self._held(random) for _ in range(3))
        shift, turn = random.uniform(-1.0, 1.0, 2), random.uniform(-1.0, 1.0)
        creases = int(random.integers(self.creases + 1))
        colours = np.rint(self.colours * random.uniform(-1.0, 1.0, (3, 3))).astype(int)
        lamp = self.light * random.uniform(-1.0, 1.0, 4)
        camera, roll = random.uniform(-1.0, 1.0, 2), random.uniform(-1.0, 1.0)
        front, back, table = ((int(r), int(g), int(b)) for r, g, b in colours)
        return Conditions(
            size=1.0 + self.size * size,
            stiffness=float(np.exp(self.stiffness * stiffness)),
            friction=1.0 + self.friction * friction,
            shift_m=_pair(self.shift_m * shift),
            turn_rad=self.turn_rad * turn,
            creases=creases,
            front=front,
            back=back,
            table=table,
            light=_varied(DAYLIGHT, lamp),
            camera_shift_m=_pair(self.camera_m * camera),
            camera_roll_rad=self.camera_roll_rad * roll,
        )

    def _held(self, random: np.random.Generator) -> float:
        """A portion of the range from -1 to 1, or of what lies beyond it."""
        within, beyond = random.uniform(-1.0, 1.0), random.uniform(1.0, HELD_OUT_BEYOND)
        return float(np.sign(within) * beyond) if self.held_out else float(within)


_MOST: Final[Mapping[str, float]] = {
    "size": 0.25,
    "stiffness": 2.0,
    "friction": 0.5,
    "shift_m": 0.15,
    "turn_rad": np.pi,
    "colours": 60.0,
    "light": 0.5,
    "camera_m": 0.3,
    "camera_roll_rad": 0.5,
    "noise": 40.0,
    "missed_grasps": 0.5,
}

OFF: Final = Randomisation()
"""Nothing differs."""

SIM2REAL: Final = Randomisation(
    size=0.1,
    stiffness=1.0,
    friction=0.25,
    shift_m=0.02,
    turn_rad=0.2,
    creases=2,
    colours=20.0,
    light=0.2,
    camera_m=0.08,
    camera_roll_rad=0.06,
    noise=4.0,
    missed_grasps=0.05,
)
"""What a policy for a robot must bear. **assumed**: the source had the robot itself."""

RANDOMISATIONS: Final[Mapping[str, Randomisation]] = {
    "off": OFF,
    "sim2real": SIM2REAL,
    "held_out": replace(OFF, size=0.1, stiffness=1.0, friction=0.25, held_out=True),
}
"""By name. "held_out" is what "sim2real" never shows: other sizes and materials, all else usual."""


def make_randomisation(given: str | Randomisation | Mapping[str, float]) -> Randomisation:
    """A randomisation by its name, by its ranges, or itself.

    Raises:
        ValueError: there is none of that name, or no such range, or one is too large.
    """
    if isinstance(given, Randomisation):
        return given
    if isinstance(given, str):
        if given not in RANDOMISATIONS:
            raise ValueError(
                f"randomisation: expected one of {', '.join(RANDOMISATIONS)}; got {given!r}; name "
                "one of them, or give ranges"
            )
        return RANDOMISATIONS[given]
    known = [field.name for field in fields(Randomisation)]
    if unknown := sorted(set(given) - set(known)):
        raise ValueError(
            f"randomisation: expected some of {', '.join(known)}; got {', '.join(unknown)}; leave "
            "out what there is not"
        )
    return Randomisation(**given)  # type: ignore[arg-type]  # its own check names a wrong value


def _varied(light: Light, portions: np.ndarray) -> Light:
    strength, ambient, x, y = (float(portion) for portion in portions)
    along_x, along_y, up = light.direction
    return Light(
        (along_x + x, along_y + y, up),
        light.ambient * (1 + ambient),
        light.strength * (1 + strength),
    )


def _added(colour: Rgb, change: Rgb) -> Rgb:
    red, green, blue = (max(0, min(255, c + d)) for c, d in zip(colour, change, strict=True))
    return red, green, blue


def _pair(array: np.ndarray) -> tuple[float, float]:
    return float(array[0]), float(array[1])
