"""What every cloth task stands on: a garment on a table, an engine that moves it, a camera."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.engine import ClothEngine, ClothEngineError, Film, PlaceableClothEngine
from actors.cloth.garments import Garment
from actors.cloth.gestures import Gesture
from actors.cloth.guard import GuardReason, guard
from actors.cloth.masks import cloth_mask
from actors.cloth.rasteriser import DAYLIGHT, ClothColours, Light, Paint, draw_cloth


@dataclass(frozen=True, eq=False)
class Look:
    """How things look: all of a picture that does not come from where the cloth is."""

    camera: Camera
    colours: ClothColours
    paint: Paint | None = None
    light: Light = DAYLIGHT
    noise: float = 0.0
    """Standard deviation of each channel of each pixel, of 255."""

    def picture(
        self,
        vertices_in_world: NDArray[np.float64],
        garment: Garment,
        random: np.random.Generator | None = None,
        camera: Camera | None = None,
    ) -> NDArray[np.uint8]:
        """u8[size, size, 3]; without random numbers it is free of noise."""
        picture = draw_cloth(
            vertices_in_world,
            garment.mesh.faces,
            camera or self.camera,
            self.colours,
            paint=self.paint,
            light=self.light,
        )
        if random is None or self.noise == 0.0:
            return picture
        noisy = picture + random.normal(0.0, self.noise, picture.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


NO_CLOTH_PX: Final = 4
"""A picture with fewer pixels of cloth shows none."""


class Scene:
    """A garment on the table, moved by gestures and seen by a camera.

    The last picture of a cloth that was in order is kept: a step that breaks the cloth, or loses
    the simulator, changes neither it nor what was measured in it.
    """

    def __init__(self, engine: ClothEngine) -> None:
        """Begin without a garment; `lay` brings one.

        Args:
            engine: not yet reset; it belongs to the scene from now on.
        """
        self._engine = engine
        self._garment: Garment | None = None
        self._look: Look | None = None
        self._picture = np.zeros((0, 0, 3), np.uint8)
        self._vertices = np.zeros((0, 3))
        self._random: np.random.Generator | None = None

    @property
    def garment(self) -> Garment:
        """What lies on the table.

        Raises:
            ClothEngineError: nothing was laid there.
        """
        if self._garment is None:
            raise ClothEngineError("Scene: expected a garment; got none; call lay() first")
        return self._garment

    @property
    def look(self) -> Look:
        """How it looks."""
        assert self._look is not None, "lay() brings garment and look"
        return self._look

    @property
    def picture(self) -> NDArray[np.uint8]:
        """What the camera last saw of a cloth in order, u8[size, size, 3]: not to be written to."""
        return self._picture

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Where that picture shows cloth, bool[size, size]."""
        return cloth_mask(self._picture)

    def vertices_in_world(self) -> NDArray[np.float64]:
        """Where the vertices last were in order, f64[V, 3], metres: as in the picture."""
        return self._vertices.copy()

    def lay(
        self,
        garment: Garment,
        vertices_in_world: NDArray[np.float64],
        look: Look,
        random: np.random.Generator,
        came_to_rest: bool = False,
    ) -> GuardReason | None:
        """Put a garment on the empty table and look at it.

        Args:
            garment: what to put there.
            vertices_in_world: f64[V, 3], where its vertices are put, metres.
            look: how it looks from now on.
            random: draws the sensor's noise, if the look has any.
            came_to_rest: the vertices are of cloth that did so earlier; an engine that can takes
                them over as they are.

        Returns:
            Why the cloth is not in order; None where it is.

        Raises:
            ClothEngineError: the simulator does not start.
        """
        self._garment, self._look, self._random = garment, look, random
        if came_to_rest and isinstance(self._engine, PlaceableClothEngine):
            self._engine.put(garment.mesh, vertices_in_world)
        else:
            self._engine.reset(garment.mesh, vertices_in_world)
        return self._see()

    def perform(self, gesture: Gesture, film: Film | None = None) -> GuardReason | None:
        """Make a gesture and look; why the cloth is not in order afterwards, None where it is."""
        try:
            self._engine.perform(gesture, film)
        except ClothEngineError:
            return GuardReason.ENGINE_LOST
        return self._see()

    def drawn(self, camera: Camera) -> NDArray[np.uint8]:
        """The scene as it is, from another camera and without noise.

        Raises:
            ClothEngineError: nothing was laid, or the simulator was lost.
        """
        return self.look.picture(self._engine.vertices_in_world(), self.garment, camera=camera)

    def close(self) -> None:
        """End the simulator; may be called twice."""
        self._engine.close()

    def _see(self) -> GuardReason | None:
        """Take the new picture, unless the cloth is not in order: then keep the last one."""
        vertices = self._engine.vertices_in_world()
        reason = guard(self.garment.mesh, vertices)
        if reason is not None:
            return reason
        picture = self.look.picture(vertices, self.garment, self._random)
        if cloth_mask(picture).sum() < NO_CLOTH_PX:
            return GuardReason.OUT_OF_VIEW
        self._picture, self._vertices = picture, vertices
        return None
