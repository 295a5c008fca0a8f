"""Pictures of the robot beside the cloth, for people: what is learned from never shows it."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.rasteriser import ClothColours, Light, Paint, Rgb, draw_cloth
from actors.robot.kinematics import HANDS, link_frames
from actors.robot.model import JOINTS, Box, Rod
from actors.robot.stances import Stance

BODY_COLOUR: Final[Rgb] = (236, 236, 240)
ARM_COLOURS: Final[tuple[Rgb, Rgb]] = ((120, 128, 140), (150, 156, 166))
"""Of an arm's links in turn."""

GRIPPER_COLOUR: Final[Rgb] = (45, 48, 56)
_SIDES = 16
_RINGS = 4
"""Of a rod's round end."""


@dataclass(frozen=True, eq=False)
class Figure:
    """A mesh and its colours."""

    vertices_m: NDArray[np.float64]
    """f64[V, 3]"""

    faces: NDArray[np.int32]
    """i32[F, 3], counter-clockwise seen from outside or from a cloth's front."""

    paint: Paint


def onlooker(stance: Stance, size_px: int) -> Camera:
    """A camera that looks at the table and the robot from before the robot and aside."""
    direction = stance.heading_rad + 0.55
    eye = Camera(
        size_px, 0.58, 0.8, np.cos(direction), np.sin(direction),
        1.0 * stance.x_m, 1.0 * stance.y_m,
    )  # fmt: skip
    right, down, forward = eye.rotation_from_world
    level = np.cross(forward, [0.0, 0.0, 1.0])
    roll_rad = float(np.arctan2(level @ down, level @ right))
    return Camera(
        size_px, eye.view_half_width_m, eye.height_m, eye.x_m, eye.y_m,
        eye.target_x_m, eye.target_y_m, roll_rad,
    )  # fmt: skip


def robot_figure(joints_rad: NDArray[np.float64], stance: Stance) -> Figure:
    """The robot in the world for joint angles f64[15]."""
    rotations, places = link_frames(joints_rad)
    vertices, faces, colours, n_vertices = [], [], [], 0
    for link, joint in enumerate(JOINTS):
        local, triangles = _mesh(joint.body)
        vertices.append(local @ rotations[link].T + places[link])
        faces.append(triangles + n_vertices)
        n_vertices += len(local)
        colours.append(np.tile(np.array(_colour(link), dtype=np.uint8), (len(triangles), 1)))
    painted = np.concatenate(colours)
    return Figure(
        stance.in_world(np.concatenate(vertices)), np.concatenate(faces), Paint(painted, painted)
    )


def draw_together(
    cloth: Figure, robot: Figure, camera: Camera, colours: ClothColours, light: Light
) -> NDArray[np.uint8]:
    """One picture of both on the table, u8[size, size, 3]."""
    fronts = np.concatenate([cloth.paint.front, robot.paint.front])
    backs = np.concatenate([cloth.paint.back, robot.paint.back])
    return draw_cloth(
        np.concatenate([cloth.vertices_m, robot.vertices_m]),
        np.concatenate([cloth.faces, robot.faces + len(cloth.vertices_m)]).astype(np.int32),
        camera,
        colours,
        paint=Paint(fronts, backs),
        light=light,
    )


def _colour(link: int) -> Rgb:
    if link in HANDS:
        return GRIPPER_COLOUR
    return BODY_COLOUR if link < 3 else ARM_COLOURS[link % 2]


@lru_cache(maxsize=len(JOINTS))
def _mesh(body: Box | Rod) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices and faces in the link's frame."""
    if isinstance(body, Box):
        signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
        half = np.array(body.size_m) / 2
        return signs * half + np.array(body.centre_m), np.array(faces, dtype=np.int32)
    latitudes = np.linspace(-np.pi / 2, np.pi / 2, 2 * _RINGS)
    turns = 2 * np.pi * np.arange(_SIDES) / _SIDES
    rings = [
        np.column_stack(
            [
                body.radius_m * np.cos(latitude) * np.cos(turns),
                body.radius_m * np.cos(latitude) * np.sin(turns),
                np.full(_SIDES, body.radius_m * np.sin(latitude))
                + np.sign(latitude) * body.core_m / 2,
            ]
        )
        for latitude in latitudes
    ]
    along_z = np.concatenate(rings)
    vertices = np.roll(along_z, body.along + 1, axis=1) + np.array(body.centre_m)
    faces = []
    for ring in range(len(rings) - 1):
        for side in range(_SIDES):
            a, b = ring * _SIDES + side, ring * _SIDES + (side + 1) % _SIDES
            faces += [(a, b, b + _SIDES), (a, b + _SIDES, a + _SIDES)]
    return vertices, np.array(faces, dtype=np.int32)
