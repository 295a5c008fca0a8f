"""What hands do to cloth: pick up and drop with one, fold along a line with two.

A gesture knows neither engine nor robot: it names vertices to take hold of and points to pass.
"""

from dataclasses import dataclass, field, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from actors.cloth.carried import CarriedPaths
from actors.cloth.grasps import check_grasp


@dataclass(frozen=True)
class GripperMotion:
    """How hands move, whatever they do."""

    lift_height_m: float = 0.10
    """Height above the table at which cloth is carried to a drop point."""

    release_height_m: float = 0.03
    """Height above the table at which a gripper lets go."""

    speed_m_per_s: float = 1.0
    """Speed along each straight line."""

    settle_secs: float = 0.2
    """Simulated time after letting go."""

    def __post_init__(self) -> None:
        """Check each number.

        Raises:
            ValueError: a number is not positive.
        """
        for setting in fields(self):
            value = getattr(self, setting.name)
            if not 0.0 < value < np.inf:
                raise ValueError(
                    f"GripperMotion.{setting.name}: expected a positive number; got {value}; "
                    f"the default is {setting.default}"
                )


@dataclass(frozen=True, eq=False)
class Hand:
    """A gripper that closes on some vertices, passes points, and opens at the last one."""

    grasped: NDArray[np.int64]
    """i64[k], k >= 1, vertex ids; the first is the one that passes through the points."""

    stations_in_world: NDArray[np.float64]
    """f64[W, 3], W >= 1, metres, without the place where the gripper closes."""

    turns_rad: NDArray[np.float64] | None = None
    """f64[W], how far the gripper is turned there since it closed; None: it is never turned."""

    turn_axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Around which it is turned, right-handed; a unit vector."""

    def stations_and_turns(self) -> NDArray[np.float64]:
        """Points and turns, f64[W, 4]."""
        n_stations = len(self.stations_in_world)
        turns = np.zeros(n_stations) if self.turns_rad is None else self.turns_rad
        return np.concatenate([self.stations_in_world, turns[:, None]], axis=1)

    def __post_init__(self) -> None:
        """Check the points and the turns.

        Raises:
            ValueError: they do not fit each other, or one is not finite.
        """
        stations = self.stations_in_world
        right_shape = stations.ndim == 2 and stations.shape[1:] == (3,) and len(stations) > 0
        if not right_shape or not np.isfinite(stations).all():
            raise ValueError(
                f"Hand.stations_in_world: expected finite f64 [W >= 1, 3]; got "
                f"{list(stations.shape)}, finite: {bool(np.isfinite(stations).all())}; "
                "give points over the table"
            )
        turns, length = self.turns_rad, float(np.linalg.norm(self.turn_axis))
        if turns is not None and (turns.shape != stations.shape[:1] or abs(length - 1.0) > 1e-6):
            raise ValueError(
                f"Hand: expected turns_rad f64 [{len(stations)}] around an axis of length 1; got "
                f"{list(turns.shape)} and {length:g}; give one angle for each station"
            )


@dataclass(frozen=True, eq=False)
class Gesture:
    """What hands do together: they close, move, and open at the same times."""

    hands: tuple[Hand, ...]
    """At least one, each with as many stations as the others."""

    motion: GripperMotion = field(default_factory=GripperMotion)

    paths: CarriedPaths | None = None
    """How the hands really move, where a robot was planned for; else straight from station to
    station."""

    def __post_init__(self) -> None:
        """Check that the hands fit each other.

        Raises:
            ValueError: there is none, or their numbers of stations differ.
        """
        numbers = [len(hand.stations_in_world) for hand in self.hands]
        if len(set(numbers)) != 1:
            raise ValueError(
                f"Gesture.hands: expected hands with equally many stations; got {numbers}; "
                "repeat a station where a hand waits"
            )

    def check(self, n_vertices: int) -> None:
        """Check that a cloth of so many vertices can be taken hold of like this.

        Raises:
            ValueError: a vertex is not there, or in two hands.
        """
        check_grasp(np.concatenate([hand.grasped for hand in self.hands]), n_vertices)


def pick_and_drop(
    vertices_in_world: NDArray[np.float64],
    grasped: NDArray[np.int64],
    drop_xy_m: tuple[float, float],
    motion: GripperMotion | None = None,
) -> Gesture:
    """Lift, carry, lower, let go.

    Args:
        vertices_in_world: f64[V, 3], where the cloth is, metres.
        grasped: i64[k], vertex ids; the first is carried to the drop point.
        drop_xy_m: where on the table, metres.
        motion: heights and speed.

    Raises:
        ValueError: the drop point is not two finite numbers, or a vertex is out of the rule.
    """
    if len(drop_xy_m) != 2 or not np.isfinite(drop_xy_m).all():
        raise ValueError(
            f"drop_xy_m: expected two finite numbers, metres; got {drop_xy_m}; "
            "give a point of the table"
        )
    check_grasp(grasped, len(vertices_in_world))
    motion = motion or GripperMotion()
    x_m, y_m = vertices_in_world[grasped[0], :2]
    stations = [
        (x_m, y_m, motion.lift_height_m),
        (drop_xy_m[0], drop_xy_m[1], motion.lift_height_m),
        (drop_xy_m[0], drop_xy_m[1], motion.release_height_m),
    ]
    return Gesture((Hand(grasped, np.array(stations, dtype=np.float64)),), motion)


def hand_paths_in_world(
    starts_in_world: NDArray[np.float64], gesture: Gesture, time_step_secs: float
) -> NDArray[np.float64]:
    """Where the hands are, one row for each time step; between two stations all keep time.

    Args:
        starts_in_world: f64[H, 3], where each hand closed, metres.
        gesture: its paths, or else stations and speed, which the hand with the longest way has.
        time_step_secs: time between two rows.

    Returns:
        f64[K, H, 4], without the start and with the end: position in metres, then how far the hand
        is turned around its axis, rad.
    """
    if gesture.paths is not None:
        rows = gesture.paths.hands_at(gesture.paths.steps_secs(time_step_secs))
        rows[..., :3] += starts_in_world - gesture.paths.positions_in_world[0]
        return rows
    starts = np.concatenate([starts_in_world, np.zeros((len(starts_in_world), 1))], axis=1)
    stations = np.stack([hand.stations_and_turns() for hand in gesture.hands], axis=1)
    step_m = gesture.motion.speed_m_per_s * time_step_secs
    return np.concatenate([_leg(a, b, step_m) for a, b in pairwise([starts, *stations])])


def turns_in_world(hand: Hand, turns_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices f64[K, 3, 3] of a hand for turns f64[K] around its axis (Rodrigues)."""
    x, y, z = hand.turn_axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sines, cosines = np.sin(turns_rad)[:, None, None], np.cos(turns_rad)[:, None, None]
    return np.asarray(np.eye(3) + sines * cross + (1.0 - cosines) * (cross @ cross))


def _leg(
    starts: NDArray[np.float64], ends: NDArray[np.float64], step_m: float
) -> NDArray[np.float64]:
    longest_m = np.linalg.norm((ends - starts)[:, :3], axis=1).max()
    # Two points at least: a first step over the whole of a short line would jerk the cloth.
    n_points = max(2, int(np.ceil(longest_m / step_m)))
    portion = np.arange(1, n_points + 1) / n_points
    points: NDArray[np.float64] = starts + portion[:, None, None] * (ends - starts)
    return points
