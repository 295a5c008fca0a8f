"""Draws cloth on the table as the camera sees it: a z-buffer, two colours, simple shading.

Coverage is decided in integers, with vertices rounded to 1/256 pixel: two triangles with a common
edge leave no gap between them and share no pixel, and every machine draws the same picture.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.compiled import compiler

_compiled: Any = compiler()

SUBPIXELS = 256

Rgb = tuple[int, int, int]


@dataclass(frozen=True)
class ClothColours:
    """Colours before shading, red, green and blue from 0 to 255.

    `actors.cloth.masks` finds the cloth by its colour: green or red on a nearly grey table.
    """

    front: Rgb = (40, 170, 60)
    back: Rgb = (200, 40, 40)
    table: Rgb = (225, 220, 205)

    def __post_init__(self) -> None:
        """Check each colour.

        Raises:
            ValueError: a colour is not three numbers from 0 to 255.
        """
        for field in fields(self):
            colour = getattr(self, field.name)
            if len(colour) != 3 or not all(0 <= channel <= 255 for channel in colour):
                raise ValueError(
                    f"ClothColours.{field.name}: expected 3 numbers from 0 to 255; got {colour}; "
                    f"the default is {field.default}"
                )


HANDKERCHIEF_COLOURS = ClothColours()
"""Green in front, red behind."""


@dataclass(frozen=True, eq=False)
class Paint:
    """Colours of a cloth that are not everywhere the same: prints and markers."""

    front: NDArray[np.uint8]
    """u8[F, 3], of each face's front side."""

    back: NDArray[np.uint8]
    """u8[F, 3], of each face's back side."""


@dataclass(frozen=True)
class Light:
    """A far lamp and what the room throws back."""

    direction: tuple[float, float, float] = (0.25, 0.20, 0.95)
    """Towards the lamp; any length."""

    ambient: float = 0.45
    """Brightness of a face that the lamp does not reach, over that of one that faces it."""

    strength: float = 1.0
    """What every colour is multiplied with."""

    def __post_init__(self) -> None:
        """Check each number.

        Raises:
            ValueError: the lamp is below the table, or a portion is out of range.
        """
        if not (np.isfinite(self.direction).all() and self.direction[2] > 0.0):
            raise ValueError(
                f"Light.direction: expected a direction upwards; got {self.direction}; "
                f"the default is {Light.direction}"
            )
        if not (0.0 <= self.ambient <= 1.0 and 0.2 <= self.strength <= 2.0):
            raise ValueError(
                "Light: expected ambient from 0 to 1 and strength from 0.2 to 2; got "
                f"{self.ambient} and {self.strength}; the defaults are 0.45 and 1"
            )

    def brightness(self, normals: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the colours of faces are multiplied with, f64[F], for unit normals f64[F, 3]."""
        towards = np.array(self.direction) / np.linalg.norm(self.direction)
        lit = np.maximum((normals * towards).sum(axis=1), 0.0)
        return np.asarray(self.strength * (self.ambient + (1.0 - self.ambient) * lit))


DAYLIGHT = Light()
"""From above, a little from the right and from behind."""


def draw_cloth(
    vertices_in_world: NDArray[np.float64],
    faces: NDArray[np.int32],
    camera: Camera,
    colours: ClothColours = HANDKERCHIEF_COLOURS,
    *,
    paint: Paint | None = None,
    light: Light = DAYLIGHT,
) -> NDArray[np.uint8]:
    """The camera's picture of cloth on the table.

    Args:
        vertices_in_world: f64[V, 3], metres, below the camera.
        faces: i32[F, 3], vertex ids, counter-clockwise seen from the front side.
        camera: from where.
        colours: of the cloth's two sides and of the table.
        paint: colours face by face, in place of those of the two sides.
        light: from where and how bright.

    Returns:
        u8[size_px, size_px, 3], red, green, blue.

    Raises:
        ValueError: a vertex is not finite, or not below the camera.
    """
    _check_vertices(vertices_in_world, camera)
    corners = np.rint(camera.project_px(vertices_in_world) * SUBPIXELS).astype(np.int64)
    nearness = 1.0 / camera.depths_m(vertices_in_world)
    front_seen = (
        _twice_area(*(corners[faces[:, k]] for k in range(3))) < 0
    )  # the picture's y is down
    fronts = np.array(colours.front) if paint is None else paint.front
    backs = np.array(colours.back) if paint is None else paint.back
    plain = np.where(front_seen[:, None], fronts, backs)
    brightness = light.brightness(_seen_normals(vertices_in_world, faces, front_seen))
    shaded = np.minimum(np.floor(plain * brightness[:, None]), 255).astype(np.uint8)
    picture = np.empty((camera.size_px, camera.size_px, 3), dtype=np.uint8)
    picture[:] = np.minimum(np.floor(np.array(colours.table) * light.strength), 255)
    _fill_triangles(corners, nearness, faces, shaded, front_seen, picture)
    return picture


def _check_vertices(vertices_in_world: NDArray[np.float64], camera: Camera) -> None:
    if not np.isfinite(vertices_in_world).all():
        raise ValueError(
            "vertices_in_world: expected finite coordinates; got a NaN or an infinity; "
            "guard() the engine's state before drawing it"
        )
    nearest_m = float(camera.depths_m(vertices_in_world).min())
    if nearest_m <= 0.0:
        highest_m = float(vertices_in_world[:, 2].max())
        raise ValueError(
            f"vertices_in_world: expected heights below the camera's {camera.height_m} m; got "
            f"{highest_m:.3f} m; guard() the engine's state before drawing it"
        )


def _seen_normals(
    vertices_in_world: NDArray[np.float64], faces: NDArray[np.int32], front_seen: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """The unit normal of each face's visible side, f64[F, 3]."""
    a, b, c = (vertices_in_world[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-15
    normals[~front_seen] *= -1.0
    return normals


def _twice_area(
    a: NDArray[np.int64], b: NDArray[np.int64], c: NDArray[np.int64]
) -> NDArray[np.int64]:
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _edge(ax: int, ay: int, bx: int, by: int, x: int, y: int) -> int:
    """Positive where (x, y) lies inside of the edge from a to b of a positive triangle.

    A pixel centre exactly on an edge belongs to the triangle whose edge runs down, or left.
    """
    value = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
    owned = by > ay or (by == ay and bx < ax)
    return value if owned else value - 1


@_compiled  # type: ignore[untyped-decorator] # numba publishes no types
def _fill_triangles(
    corners: NDArray[np.int64],
    nearness: NDArray[np.float64],
    faces: NDArray[np.int32],
    shaded: NDArray[np.uint8],
    front_seen: NDArray[np.bool_],
    picture: NDArray[np.uint8],
) -> None:
    """Draw each face where it is nearer than what the picture holds already."""
    height_px, width_px = picture.shape[0], picture.shape[1]
    nearest = np.zeros((height_px, width_px))
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if front_seen[f]:
            b, c = c, b
        ax, ay = corners[a, 0], corners[a, 1]
        bx, by = corners[b, 0], corners[b, 1]
        cx, cy = corners[c, 0], corners[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0:
            continue
        first_column = max(min(ax, bx, cx) // SUBPIXELS, 0)
        last_column = min(max(ax, bx, cx) // SUBPIXELS, width_px - 1)
        first_row = max(min(ay, by, cy) // SUBPIXELS, 0)
        last_row = min(max(ay, by, cy) // SUBPIXELS, height_px - 1)
        for row in range(first_row, last_row + 1):
            y = row * SUBPIXELS + SUBPIXELS // 2
            for column in range(first_column, last_column + 1):
                x = column * SUBPIXELS + SUBPIXELS // 2
                to_a = _edge(bx, by, cx, cy, x, y)
                to_b = _edge(cx, cy, ax, ay, x, y)
                to_c = _edge(ax, ay, bx, by, x, y)
                if to_a < 0 or to_b < 0 or to_c < 0:
                    continue
                # 1 / distance is linear in the picture, the distance itself is not.
                near = (to_a * nearness[a] + to_b * nearness[b] + to_c * nearness[c]) / area
                if near > nearest[row, column]:
                    nearest[row, column] = near
                    for channel in range(3):
                        picture[row, column, channel] = shaded[f, channel]
