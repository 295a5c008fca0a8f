"""What may be chosen for any cloth task."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from actors.cloth.engines import Settings
from actors.envs.arguments import check_range, check_render_mode, check_size
from actors.envs.initial_states import InitialState, check_initial_state
from actors.envs.randomisation import Randomisation, make_randomisation
from actors.robot.stances import check_stance


@dataclass(frozen=True)
class ClothTaskOptions:
    """What may be chosen for any cloth task, by keyword in `make_env` and in a preset."""

    horizon: int = 30
    """Steps in an episode."""

    engine: str = "xpbd"
    """A name of `actors.cloth.engines`."""

    engine_settings: Settings | None = None
    """The engine's own numbers where they differ from its defaults."""

    sizes: Mapping[str, float] | None = None
    """The garment's lengths where they differ from its defaults; see `actors.cloth.outlines`."""

    spacing_m: float | None = None
    """How far apart the garment's vertices are; by default the engine's usual."""

    obj_path: str | None = None
    """A garment of your own instead of the task's; see `actors.cloth.obj_files`."""

    metres_per_unit: float = 1.0
    """Of that file."""

    view_half_width_m: float = 0.26
    """Half the width of the table that the picture shows."""

    initial_state: InitialState = "flat"
    """See `actors.envs.initial_states`; `reset(options={"initial_state": ...})` overrules it."""

    automatic_reset: bool = False
    """Begin an episode by spreading the handkerchief that lies there; see
    `actors.envs.automatic_reset`."""

    stored_states: str | None = None
    """Begin with states of this file, or of this name; see `actors.envs.stored_states`.

    Where the garment lies is then the file's alone: neither the options below nor a randomisation
    moves it. The seed draws one of those of the chosen initial state;
    `reset(options={"stored_index": 3})` names one.
    """

    start_shift_m: float = 0.0
    """The garment begins at most this far from its place, along x and along y."""

    start_turn_rad: float = 0.0
    """The garment begins turned by at most this, either way."""

    randomisation: str | Randomisation | Mapping[str, float] = "off"
    """A name, or ranges; see `actors.envs.randomisation`."""

    robot: bool = False
    """The robot makes each gesture, as fast as it can; what its arms cannot do is not done."""

    robot_stance: str = "front"
    """Where it stands; see `actors.robot.stances`."""

    observation_px: int = 84
    """Width and height of the observation."""

    render_px: int = 336
    """Width and height of what `render` returns."""

    render_mode: str | None = None
    """None or "rgb_array"."""

    def __post_init__(self) -> None:
        """Check each value.

        Raises:
            ValueError: one is out of its rule.
        """
        check_size("observation_px", self.observation_px, least=16)
        check_size("render_px", self.render_px, least=self.observation_px)
        check_range("view_half_width_m", self.view_half_width_m, 0.05, 0.6)
        check_range("start_shift_m", self.start_shift_m, 0.0, 0.1)
        check_range("start_turn_rad", self.start_turn_rad, 0.0, np.pi)
        check_initial_state(self.initial_state)
        check_render_mode(self.render_mode)
        check_stance(self.robot_stance)
        randomisation = make_randomisation(self.randomisation)
        if self.stored_states is not None and randomisation.size > 0.0:
            raise ValueError(
                "stored_states: expected a randomisation that leaves the garment's size alone; got "
                f"size {randomisation.size}; stored cloth has one size, choose another"
            )
        if self.stored_states is not None and self.automatic_reset:
            raise ValueError(
                "stored_states: expected no automatic_reset; got both; stored cloth must be put "
                "where it is said to lie, choose one of them"
            )
