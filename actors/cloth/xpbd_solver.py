"""Extended position-based dynamics with small steps, compiled.

Each substep moves the vertices by their velocities, then corrects positions: every distance
constraint once, layers that are too close, the table. Velocities are what the positions did. One
substep with one sweep converges better than one step with many sweeps, and no step is large enough
to explode.

Of fast-math only fused multiply-add is allowed: sums keep their order, so that every CPU which has
it computes the same bits.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

GRAVITY_M_PER_S2 = 9.8
_NO_VERTEX = -1
_TINY = 1e-12

_compiled: Any = numba.njit(cache=True, error_model="numpy", fastmath={"contract"})


class Distances(NamedTuple):
    """`DistanceConstraints` as the solver reads them."""

    pairs: NDArray[np.int32]
    rest_lengths_m: NDArray[np.float64]
    softnesses: NDArray[np.float64]
    """Compliance over the squared substep, f64[C]."""
    neighbours: NDArray[np.int32]
    first_neighbour: NDArray[np.int32]


class Numbers(NamedTuple):
    """Settings of a simulation, in units of metres and seconds."""

    substep_secs: float
    thickness_m: float
    table_friction: float
    layer_friction: float
    damping_per_sec: float
    fastest_m_per_s: float
    grid_origin_m: float
    """The grid in which close vertices are looked for begins here, along x and y."""
    cell_m: float
    skin_m: float
    """Vertices are looked up again once one has moved half of it."""


class Body(NamedTuple):
    """The state and the working memory of one cloth; the solver writes into all of it."""

    positions_m: NDArray[np.float64]
    """f64[V, 3], in the world's frame."""
    velocities_m_per_s: NDArray[np.float64]
    inverse_masses: NDArray[np.float64]
    """f64[V]: 1, or 0 for what is grasped."""
    previous_m: NDArray[np.float64]
    listed_at_m: NDArray[np.float64]
    """f64[V, 3], where the vertices were when close pairs were last looked up."""
    close_pairs: NDArray[np.int32]
    """i32[P, 2], P is room enough."""
    n_close_pairs: NDArray[np.int64]
    """i64[1]; -1 when they must be looked up."""
    first_in_cell: NDArray[np.int32]
    """i32[cells, cells]."""
    next_in_cell: NDArray[np.int32]


@_compiled  # type: ignore[untyped-decorator]  # numba publishes no types
def advance(
    body: Body,
    distances: Distances,
    numbers: Numbers,
    grasped: NDArray[np.int64],
    path_m: NDArray[np.float64],
    n_substeps: int,
) -> float:
    """Simulates substeps.

    Args:
        body: The cloth.
        distances: Its constraints.
        numbers: Its settings.
        grasped: i64[k], vertices that are moved along `path_m`.
        path_m: f64[n_substeps, k, 3], where they are after each substep.
        n_substeps: How many.

    Returns:
        The fastest vertex's speed in the last substep, m/s; infinite when close pairs did not fit.
    """
    fastest: float = 0.0
    for substep in range(n_substeps):
        _move(body, numbers)
        for index in range(len(grasped)):
            for axis in range(3):
                body.positions_m[grasped[index], axis] = path_m[substep, index, axis]
        if not _list_close_pairs(body, distances, numbers):
            return np.inf
        _keep_distances(body, distances)
        _keep_layers_apart(body, numbers)
        _keep_above_table(body, numbers)
        fastest = _derive_velocities(body, numbers)
    return fastest


@_compiled
def _move(body, numbers):  # type: ignore[no-untyped-def]
    positions, velocities, previous = body.positions_m, body.velocities_m_per_s, body.previous_m
    step = numbers.substep_secs
    for i in range(len(positions)):
        x, y, z = velocities[i, 0], velocities[i, 1], velocities[i, 2]
        previous[i, 0], previous[i, 1], previous[i, 2] = (
            positions[i, 0],
            positions[i, 1],
            positions[i, 2],
        )
        if body.inverse_masses[i] == 0.0:
            continue
        z -= GRAVITY_M_PER_S2 * step
        speed = np.sqrt(x * x + y * y + z * z)
        portion = step
        if speed > numbers.fastest_m_per_s:
            portion = step * numbers.fastest_m_per_s / speed
        positions[i, 0] += portion * x
        positions[i, 1] += portion * y
        positions[i, 2] += portion * z


@_compiled
def _keep_distances(body, distances):  # type: ignore[no-untyped-def]
    """One Gauss-Seidel sweep over the compliant distance constraints."""
    positions, masses = body.positions_m, body.inverse_masses
    pairs, lengths, softnesses = distances.pairs, distances.rest_lengths_m, distances.softnesses
    for c in range(len(pairs)):
        i, j = pairs[c, 0], pairs[c, 1]
        weight_i, weight_j = masses[i], masses[j]
        x = positions[i, 0] - positions[j, 0]
        y = positions[i, 1] - positions[j, 1]
        z = positions[i, 2] - positions[j, 2]
        length = np.sqrt(x * x + y * y + z * z) + _TINY
        stiffness = weight_i + weight_j + softnesses[c] + _TINY
        correction = (lengths[c] - length) / (stiffness * length)
        at_i, at_j = correction * weight_i, correction * weight_j
        positions[i, 0] += at_i * x
        positions[i, 1] += at_i * y
        positions[i, 2] += at_i * z
        positions[j, 0] -= at_j * x
        positions[j, 1] -= at_j * y
        positions[j, 2] -= at_j * z


@_compiled
def _keep_layers_apart(body, numbers):  # type: ignore[no-untyped-def]
    """Pushes close vertices apart, and lets them drag each other along."""
    positions, previous, masses = body.positions_m, body.previous_m, body.inverse_masses
    thickness = numbers.thickness_m
    for p in range(body.n_close_pairs[0]):
        i, j = body.close_pairs[p, 0], body.close_pairs[p, 1]
        total = masses[i] + masses[j]
        x = positions[i, 0] - positions[j, 0]
        y = positions[i, 1] - positions[j, 1]
        z = positions[i, 2] - positions[j, 2]
        squared = x * x + y * y + z * z
        if squared >= thickness * thickness or total == 0.0:
            continue
        length = np.sqrt(squared) + _TINY
        push = (thickness - length) / (length * total)
        drag = numbers.layer_friction / total
        for axis in range(3):
            offset = positions[i, axis] - positions[j, axis]
            moved_i = positions[i, axis] - previous[i, axis]
            moved_j = positions[j, axis] - previous[j, axis]
            change = push * offset - drag * (moved_i - moved_j + push * total * offset)
            positions[i, axis] += masses[i] * change
            positions[j, axis] -= masses[j] * change


@_compiled
def _keep_above_table(body, numbers):  # type: ignore[no-untyped-def]
    """The table holds the cloth up, and back by Coulomb friction."""
    positions, previous = body.positions_m, body.previous_m
    least = numbers.thickness_m / 2
    for i in range(len(positions)):
        depth = least - positions[i, 2]
        if depth <= 0.0 or body.inverse_masses[i] == 0.0:
            continue
        positions[i, 2] = least
        x, y = positions[i, 0] - previous[i, 0], positions[i, 1] - previous[i, 1]
        slid = np.sqrt(x * x + y * y) + _TINY
        held = min(1.0, numbers.table_friction * depth / slid)
        positions[i, 0] -= held * x
        positions[i, 1] -= held * y


@_compiled
def _derive_velocities(body, numbers):  # type: ignore[no-untyped-def]
    positions, velocities, previous = body.positions_m, body.velocities_m_per_s, body.previous_m
    kept = (1.0 - numbers.damping_per_sec * numbers.substep_secs) / numbers.substep_secs
    fastest = 0.0
    for i in range(len(positions)):
        squared = 0.0
        for axis in range(3):
            velocity = (positions[i, axis] - previous[i, axis]) * kept
            velocities[i, axis] = velocity
            squared += velocity * velocity
        if not squared <= fastest:  # so that a vertex that is no number counts as fastest
            fastest = squared
    return np.sqrt(fastest)


@_compiled
def _list_close_pairs(body, distances, numbers):  # type: ignore[no-untyped-def]
    """Looks close pairs up again if a vertex has moved too far; whether they fit."""
    positions, listed = body.positions_m, body.listed_at_m
    if body.n_close_pairs[0] >= 0:
        furthest = 0.0
        for i in range(len(positions)):
            x = positions[i, 0] - listed[i, 0]
            y = positions[i, 1] - listed[i, 1]
            z = positions[i, 2] - listed[i, 2]
            furthest = max(furthest, x * x + y * y + z * z)
        if furthest <= 0.25 * numbers.skin_m * numbers.skin_m:
            return True
    listed[:] = positions
    _sort_into_cells(body, numbers)
    count = 0
    for i in range(len(positions)):
        count = _list_close_to(body, distances, numbers, i, count)
        if count < 0:
            return False
    body.n_close_pairs[0] = count
    return True


@_compiled
def _cell_of(coordinate_m, numbers, n_cells):  # type: ignore[no-untyped-def]
    # Compared as a float: what is no number must not become an index.
    cell = (coordinate_m - numbers.grid_origin_m) / numbers.cell_m
    if cell > 0.0:
        return int(min(cell, n_cells - 1.0))
    return 0


@_compiled
def _sort_into_cells(body, numbers):  # type: ignore[no-untyped-def]
    n_cells = len(body.first_in_cell)
    body.first_in_cell[:] = _NO_VERTEX
    for i in range(len(body.positions_m)):
        column = _cell_of(body.positions_m[i, 0], numbers, n_cells)
        row = _cell_of(body.positions_m[i, 1], numbers, n_cells)
        body.next_in_cell[i] = body.first_in_cell[row, column]
        body.first_in_cell[row, column] = i


@_compiled
def _list_close_to(body, distances, numbers, i, count):  # type: ignore[no-untyped-def]
    """Appends the pairs of vertex i with later ones; the new count, or -1 if there is no room."""
    positions, n_cells = body.positions_m, len(body.first_in_cell)
    reach = numbers.thickness_m + numbers.skin_m
    x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
    column, row = _cell_of(x, numbers, n_cells), _cell_of(y, numbers, n_cells)
    for near_row in range(max(row - 1, 0), min(row + 2, n_cells)):
        for near_column in range(max(column - 1, 0), min(column + 2, n_cells)):
            j = body.first_in_cell[near_row, near_column]
            while j != _NO_VERTEX:
                if j > i:
                    dx, dy, dz = x - positions[j, 0], y - positions[j, 1], z - positions[j, 2]
                    is_close = dx * dx + dy * dy + dz * dz < reach * reach
                    if is_close and not _never_collide(distances, i, j):
                        if count == len(body.close_pairs):
                            return -1
                        body.close_pairs[count, 0], body.close_pairs[count, 1] = i, j
                        count += 1
                j = body.next_in_cell[j]
    return count


@_compiled
def _never_collide(distances, i, j):  # type: ignore[no-untyped-def]
    for k in range(distances.first_neighbour[i], distances.first_neighbour[i + 1]):
        if distances.neighbours[k] == j:
            return True
    return False
