"""Extended position-based dynamics with small steps, compiled.

Each substep moves the vertices by their velocities, then corrects positions: every distance
constraint once, layers that are too close, the table. Velocities are what the positions did. One
substep with one sweep converges better than one step with many sweeps, and no step is large enough
to explode.

Of fast-math only fused multiply-add is allowed: sums keep their order, so that every CPU which has
it computes the same bits.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.compiled import compiler

GRAVITY_M_PER_S2 = 9.8
_TINY = 1e-12

_compiled: Any = compiler(error_model="numpy", fastmath={"contract"})


class Distances(NamedTuple):
    """`DistanceConstraints` as the solver reads them."""

    pairs: NDArray[np.int32]
    squared_lengths_m2: NDArray[np.float64]
    """Of the distances at rest, f64[C]."""
    softnesses: NDArray[np.float64]
    """Compliance over the squared substep, f64[C]."""
    shares: NDArray[np.float64]
    """f64[C, 2], working memory: how much of a correction either vertex takes."""
    rest_m: NDArray[np.float64]
    """f64[3, V], where the vertices of the cloth at rest are."""


class Numbers(NamedTuple):
    """Settings of a simulation, in units of metres and seconds."""

    substep_secs: float
    thickness_m: float
    table_friction: float
    layer_friction: float
    damping_per_sec: float
    fastest_m_per_s: float
    neighbours_m: float
    """Vertices that are closer at rest are kept apart by their distances, not as layers."""
    grid_origin_m: float
    """The grid in which close vertices are looked for begins here, along x and y."""
    cell_m: float
    n_cells: int
    """Along x and along y."""
    skin_m: float
    """Vertices are looked up again once one has moved half of it."""


class Body(NamedTuple):
    """The state and the working memory of one cloth; the solver writes into all of it.

    Coordinates lie axis by axis, so that loops over the vertices use vector instructions.
    """

    positions_m: NDArray[np.float64]
    """f64[3, V], in the world's frame."""
    velocities_m_per_s: NDArray[np.float64]
    """f64[3, V]."""
    inverse_masses: NDArray[np.float64]
    """f64[V]: 1, or 0 for what is grasped."""
    previous_m: NDArray[np.float64]
    """f64[3, V]."""
    listed_at_m: NDArray[np.float64]
    """f64[3, V], where the vertices were when close pairs were last looked up."""
    close_pairs: NDArray[np.int32]
    """i32[P, 2], P is room enough."""
    n_close_pairs: NDArray[np.int64]
    """i64[1]; -1 when they must be looked up."""
    cells: NDArray[np.int32]
    """i32[V], in which cell each vertex was then; cells are numbered row by row."""
    first_in_cell: NDArray[np.int32]
    """i32[cells + 1], where in `by_cell` the vertices of each cell begin."""
    by_cell: NDArray[np.int32]
    """i32[V], vertices in the order of their cells."""


@_compiled  # type: ignore[untyped-decorator]  # numba publishes no types
def share_corrections(body: Body, distances: Distances) -> None:
    """How a distance's error is shared out: by inverse masses, and less of it where it is soft.

    To be called whenever inverse masses have changed.
    """
    pairs, softnesses, shares = distances.pairs, distances.softnesses, distances.shares
    for c in range(len(pairs)):
        one, other = body.inverse_masses[pairs[c, 0]], body.inverse_masses[pairs[c, 1]]
        stiffness = one + other + softnesses[c] + _TINY
        shares[c, 0], shares[c, 1] = one / stiffness, other / stiffness


@_compiled  # type: ignore[untyped-decorator]
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
    for substep in range(n_substeps):
        _move(body, numbers)
        for index in range(len(grasped)):
            for axis in range(3):
                body.positions_m[axis, grasped[index]] = path_m[substep, index, axis]
        if not _list_close_pairs(body, distances, numbers):
            return np.inf
        _keep_distances(body, distances)
        _keep_layers_apart(body, numbers)
        _keep_above_table(body, numbers)
    return float(_fastest(body))


@_compiled  # type: ignore[untyped-decorator]
def most_stretch(body: Body, distances: Distances) -> float:
    """Length over length at rest of the pair that is stretched most."""
    x, y, z = body.positions_m
    pairs, squares = distances.pairs, distances.squared_lengths_m2
    most = 0.0
    for c in range(len(pairs)):
        i, j = pairs[c, 0], pairs[c, 1]
        dx, dy, dz = x[i] - x[j], y[i] - y[j], z[i] - z[j]
        most = max(most, (dx * dx + dy * dy + dz * dz) / squares[c])
    return float(np.sqrt(most))


@_compiled
def _move(body, numbers):  # type: ignore[no-untyped-def]
    x, y, z = body.positions_m
    u, v, w = body.velocities_m_per_s
    body.previous_m[:] = body.positions_m
    step, most = numbers.substep_secs, numbers.fastest_m_per_s
    for i in range(len(x)):
        falling = w[i] - GRAVITY_M_PER_S2 * step
        speed = np.sqrt(u[i] * u[i] + v[i] * v[i] + falling * falling)
        portion = step * most / speed if speed > most else step
        portion *= body.inverse_masses[i]
        x[i] += portion * u[i]
        y[i] += portion * v[i]
        z[i] += portion * falling


@_compiled
def _keep_distances(body, distances):  # type: ignore[no-untyped-def]
    """One Gauss-Seidel sweep over the compliant distance constraints.

    The relative error l / length - 1 is taken as (l^2 - length^2) / (l^2 + length^2): the same to
    first order, without a root, and bounded however close two vertices are.
    """
    x, y, z = body.positions_m
    pairs, squares, shares = distances.pairs, distances.squared_lengths_m2, distances.shares
    for c in range(len(pairs)):
        i, j = pairs[c, 0], pairs[c, 1]
        dx, dy, dz = x[i] - x[j], y[i] - y[j], z[i] - z[j]
        squared = dx * dx + dy * dy + dz * dz
        error = (squares[c] - squared) / (squares[c] + squared)
        at_i, at_j = error * shares[c, 0], error * shares[c, 1]
        x[i] += at_i * dx
        y[i] += at_i * dy
        z[i] += at_i * dz
        x[j] -= at_j * dx
        y[j] -= at_j * dy
        z[j] -= at_j * dz


@_compiled
def _keep_layers_apart(body, numbers):  # type: ignore[no-untyped-def]
    """Pushes close vertices apart, and lets them drag each other along."""
    positions, previous, masses = body.positions_m, body.previous_m, body.inverse_masses
    x, y, z = positions
    thickness = numbers.thickness_m
    for p in range(body.n_close_pairs[0]):
        i, j = body.close_pairs[p, 0], body.close_pairs[p, 1]
        dx, dy, dz = x[i] - x[j], y[i] - y[j], z[i] - z[j]
        squared = dx * dx + dy * dy + dz * dz
        total = masses[i] + masses[j]
        if squared >= thickness * thickness or total == 0.0:
            continue
        length = np.sqrt(squared) + _TINY
        push = (thickness - length) / (length * total)
        drag = numbers.layer_friction / total
        for axis in range(3):
            offset = positions[axis, i] - positions[axis, j]
            moved_i = positions[axis, i] - previous[axis, i]
            moved_j = positions[axis, j] - previous[axis, j]
            change = push * offset - drag * (moved_i - moved_j + push * total * offset)
            positions[axis, i] += masses[i] * change
            positions[axis, j] -= masses[j] * change


@_compiled
def _keep_above_table(body, numbers):  # type: ignore[no-untyped-def]
    """The table holds the cloth up, and back by Coulomb friction; velocities are what is left."""
    x, y, z = body.positions_m
    u, v, w = body.velocities_m_per_s
    from_x, from_y, from_z = body.previous_m
    least, friction = numbers.thickness_m / 2, numbers.table_friction
    kept = (1.0 - numbers.damping_per_sec * numbers.substep_secs) / numbers.substep_secs
    for i in range(len(x)):
        depth = (least - z[i]) * body.inverse_masses[i]
        pressed = depth if depth > 0.0 else 0.0
        dx, dy = x[i] - from_x[i], y[i] - from_y[i]
        slid = np.sqrt(dx * dx + dy * dy) + _TINY
        held = friction * pressed / slid
        slides = 1.0 - held if held < 1.0 else 0.0
        x[i] = from_x[i] + slides * dx
        y[i] = from_y[i] + slides * dy
        z[i] += pressed
        u[i] = (x[i] - from_x[i]) * kept
        v[i] = (y[i] - from_y[i]) * kept
        w[i] = (z[i] - from_z[i]) * kept


@_compiled
def _fastest(body):  # type: ignore[no-untyped-def]
    u, v, w = body.velocities_m_per_s
    fastest = 0.0
    for i in range(len(u)):
        squared = u[i] * u[i] + v[i] * v[i] + w[i] * w[i]
        if not squared <= fastest:  # so that a vertex that is no number counts as fastest
            fastest = squared
    return np.sqrt(fastest)


@_compiled
def _list_close_pairs(body, distances, numbers):  # type: ignore[no-untyped-def]
    """Looks close pairs up again if a vertex has moved too far; whether they fit."""
    if body.n_close_pairs[0] >= 0 and _moved_far(body, 0.5 * numbers.skin_m) == 0:
        return True
    body.listed_at_m[:] = body.positions_m
    _sort_into_cells(body, numbers)
    x, y, z = body.positions_m
    rest_x, rest_y, rest_z = distances.rest_m
    by_cell, close_pairs, n_cells = body.by_cell, body.close_pairs, numbers.n_cells
    reach = (numbers.thickness_m + numbers.skin_m) ** 2
    neighbours = numbers.neighbours_m**2
    count = 0
    for place in range(len(x)):
        i = by_cell[place]
        row, column = body.cells[i] // n_cells, body.cells[i] % n_cells
        # Each pair once: with those behind it in its row of cells, and with all in the next row.
        for near_row in range(row, min(row + 2, n_cells)):
            first = body.first_in_cell[near_row * n_cells + max(column - 1, 0)]
            end = body.first_in_cell[near_row * n_cells + min(column + 1, n_cells - 1) + 1]
            for near in range(place + 1 if near_row == row else first, end):
                j = by_cell[near]
                dx, dy, dz = x[i] - x[j], y[i] - y[j], z[i] - z[j]
                if dx * dx + dy * dy + dz * dz >= reach:
                    continue
                dx, dy, dz = rest_x[i] - rest_x[j], rest_y[i] - rest_y[j], rest_z[i] - rest_z[j]
                if dx * dx + dy * dy + dz * dz < neighbours:
                    continue
                if count == len(close_pairs):
                    return False
                close_pairs[count, 0], close_pairs[count, 1] = i, j
                count += 1
    body.n_close_pairs[0] = count
    return True


@_compiled
def _moved_far(body, limit_m):  # type: ignore[no-untyped-def]
    """How many vertices have moved further than a limit since close pairs were looked up."""
    x, y, z = body.positions_m
    from_x, from_y, from_z = body.listed_at_m
    limit = limit_m * limit_m
    count = 0
    for i in range(len(x)):
        dx, dy, dz = x[i] - from_x[i], y[i] - from_y[i], z[i] - from_z[i]
        count += 0 if dx * dx + dy * dy + dz * dz <= limit else 1
    return count


@_compiled
def _sort_into_cells(body, numbers):  # type: ignore[no-untyped-def]
    """A counting sort: those of cells side by side in one row are then one range."""
    x, y, _ = body.positions_m
    cells, first_in_cell, by_cell = body.cells, body.first_in_cell, body.by_cell
    n_cells = numbers.n_cells
    first_in_cell[:] = 0
    for i in range(len(x)):
        column, row = _cell_of(x[i], numbers), _cell_of(y[i], numbers)
        cells[i] = row * n_cells + column
        first_in_cell[cells[i]] += 1
    for cell in range(1, len(first_in_cell)):
        first_in_cell[cell] += first_in_cell[cell - 1]  # where the cell ends, for now
    for i in range(len(x) - 1, -1, -1):
        first_in_cell[cells[i]] -= 1
        by_cell[first_in_cell[cells[i]]] = i


@_compiled
def _cell_of(coordinate_m, numbers):  # type: ignore[no-untyped-def]
    # Compared as a float: what is no number must not become an index.
    cell = (coordinate_m - numbers.grid_origin_m) / numbers.cell_m
    if cell > 0.0:
        return int(min(cell, numbers.n_cells - 1.0))
    return 0
