"""How far the robot's links are from each other and from the table: compiled.

Of the shapes of the URDF, as PyBullet would say, about a thousand times faster.
"""

from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.robot.kinematics import HANDS, PARENTS, compiled, fill_frames
from actors.robot.model import JOINTS, Box, Rod

NEIGHBOURS: Final = 2
"""Links so many joints apart always overlap a little, as the shapes are thick."""

FAR_M: Final = 0.05
"""What is farther apart is not measured exactly."""

_ROUNDS = 16


def are_neighbours(one: int, two: int) -> bool:
    """Whether one of two links carries the other over at most `NEIGHBOURS` joints."""
    for start, goal in ((one, two), (two, one)):
        link = start
        for _ in range(NEIGHBOURS):
            link = int(PARENTS[link]) if link >= 0 else -1
            if link == goal:
                return True
    return False


def least_clearances_m(
    joints_rad: NDArray[np.float64], table_height_m: float
) -> tuple[float, float]:
    """The least distances among links that are no neighbours, and of arms from the table.

    Grippers may touch the table, and cloth: they are not counted there. The first is at most
    `FAR_M`.

    Args:
        joints_rad: f64[K, 15], angles; the least over all of them counts.
        table_height_m: of its top in the robot's frame; the table ends nowhere.
    """
    own, table = _least(np.ascontiguousarray(joints_rad), table_height_m)
    return float(own), float(table)


def dense(way: NDArray[np.float64], step_rad: float) -> NDArray[np.float64]:
    """The same way f64[K, 15] with so many rows f64[N, 15] that no joint moves more between two."""
    moves = np.abs(np.diff(way, axis=0)).max(axis=1)
    n_steps = np.maximum(1, np.ceil(moves / step_rad).astype(np.int64))
    leg = np.repeat(np.arange(len(n_steps)), n_steps)
    first = np.repeat(np.cumsum(n_steps) - n_steps, n_steps)
    portion = (np.arange(len(leg)) - first) / n_steps[leg]
    rows = way[leg] + portion[:, None] * (way[leg + 1] - way[leg])
    return np.concatenate([rows, way[-1:]])


def _rod_ends(body: Box | Rod) -> tuple[list[float], list[float], float]:
    if isinstance(body, Box):
        return list(body.centre_m), list(body.centre_m), 0.0
    ends = [list(body.centre_m), list(body.centre_m)]
    ends[0][body.along] -= body.core_m / 2
    ends[1][body.along] += body.core_m / 2
    return ends[0], ends[1], body.radius_m


_RODS = [_rod_ends(joint.body) for joint in JOINTS]
_ENDS_M = np.array([rod[:2] for rod in _RODS])
_RADII_M = np.array([rod[2] for rod in _RODS])
_HALF_SIZES_M = np.array(
    [np.array(it.body.size_m) / 2 if isinstance(it.body, Box) else np.zeros(3) for it in JOINTS]
)
_HALF_LENGTHS_M = np.array(
    [
        np.linalg.norm(it.body.size_m) / 2
        if isinstance(it.body, Box)
        else it.body.core_m / 2 + it.body.radius_m
        for it in JOINTS
    ]
)
_IS_BOX = np.array([isinstance(joint.body, Box) for joint in JOINTS])
_PAIRS = np.array(
    [
        sorted(pair, key=lambda link: not _IS_BOX[link])  # the box first
        for pair in combinations(range(len(JOINTS)), 2)
        if not are_neighbours(*pair)
    ]
)
_ARM_LINKS = np.array([link for hand in HANDS for link in range(hand - 5, hand)])
assert not any(_IS_BOX[one] and _IS_BOX[two] for one, two in _PAIRS)


@compiled
def _least(joints, table_height):  # type: ignore[no-untyped-def]
    n = joints.shape[1]
    rotations, places, ends = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 2, 3))
    own, table = FAR_M, np.inf
    for k in range(len(joints)):
        fill_frames(joints[k], rotations, places)
        _fill_ends(rotations, places, ends)
        for one, two in _PAIRS:
            if _are_far(one, two, ends):
                continue
            if _IS_BOX[one]:
                distance = _from_box(one, rotations, ends, two)
            else:
                distance = _between(ends[one], ends[two])
            own = min(own, distance - _RADII_M[one] - _RADII_M[two])
        for link in _ARM_LINKS:
            lowest = min(ends[link, 0, 2], ends[link, 1, 2]) - _RADII_M[link]
            table = min(table, lowest - table_height)
    return own, table


@compiled
def _fill_ends(rotations, places, ends):  # type: ignore[no-untyped-def]
    """Where each link's axis begins and ends; of boxes the middle, twice."""
    for link in range(len(places)):
        for end in range(2):
            for row in range(3):
                ends[link, end, row] = places[link, row]
                for column in range(3):
                    ends[link, end, row] += (
                        rotations[link, row, column] * _ENDS_M[link, end, column]
                    )


@compiled
def _are_far(one, two, ends):  # type: ignore[no-untyped-def]
    """Whether balls around both are more than `FAR_M` apart."""
    squared = 0.0
    for i in range(3):
        squared += (ends[one, 0, i] + ends[one, 1, i] - ends[two, 0, i] - ends[two, 1, i]) ** 2
    far = FAR_M + _HALF_LENGTHS_M[one] + _HALF_LENGTHS_M[two]
    return squared > (2.0 * far) ** 2


@compiled
def _between(one, two):  # type: ignore[no-untyped-def]
    """The distance of two segments f64[2, 3]."""
    aa = bb = ab = ac = bc = 0.0
    for i in range(3):
        a, b, c = one[1, i] - one[0, i], two[1, i] - two[0, i], one[0, i] - two[0, i]
        aa, bb, ab, ac, bc = aa + a * a, bb + b * b, ab + a * b, ac + a * c, bc + b * c
    slant = aa * bb - ab * ab
    s = min(max((ab * bc - ac * bb) / slant, 0.0), 1.0) if slant > 1e-12 else 0.0
    t = min(max((ab * s + bc) / bb, 0.0), 1.0)
    s = min(max((ab * t - ac) / aa, 0.0), 1.0)
    squared = 0.0
    for i in range(3):
        on_one = one[0, i] + s * (one[1, i] - one[0, i])
        on_two = two[0, i] + t * (two[1, i] - two[0, i])
        squared += (on_one - on_two) ** 2
    return np.sqrt(squared)


@compiled
def _from_box(box, rotations, ends, rod):  # type: ignore[no-untyped-def]
    """The distance of a segment from a box: convex along it, so that narrowing down finds it."""
    low, high = 0.0, 1.0
    for _ in range(_ROUNDS):
        third = (high - low) / 3.0
        near_low = _point_from_box(box, rotations, ends, rod, low + third)
        near_high = _point_from_box(box, rotations, ends, rod, high - third)
        if near_low < near_high:
            high -= third
        else:
            low += third
    return _point_from_box(box, rotations, ends, rod, (low + high) / 2.0)


@compiled
def _point_from_box(box, rotations, ends, rod, portion):  # type: ignore[no-untyped-def]
    """The distance of a point of a segment from a box; 0 inside of it."""
    squared = 0.0
    for axis in range(3):
        along = 0.0
        for row in range(3):
            point = ends[rod, 0, row] + portion * (ends[rod, 1, row] - ends[rod, 0, row])
            along += rotations[box, row, axis] * (point - ends[box, 0, row])
        squared += max(abs(along) - _HALF_SIZES_M[box, axis], 0.0) ** 2
    return np.sqrt(squared)
