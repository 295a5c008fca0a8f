"""Outlines of garments that lie spread out, from a few lengths and angles.

World frame of a garment: its middle at the origin, x to the right, y towards the collar or waist.
Every length is a field, so that sizes can be varied; nothing here is random.
"""

from dataclasses import dataclass, fields
from math import cos, pi, sin

import numpy as np
from numpy.typing import NDArray

Point = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Outline:
    """A closed polygon, counter-clockwise, and the names of some points of it."""

    corners_m: NDArray[np.float64]
    """f64[K, 2], K >= 3, metres, without the first point again at the end."""

    keypoints_m: dict[str, Point]
    """Places that rewards and measures speak of, such as "hem_left": left in the picture."""


@dataclass(frozen=True)
class HandkerchiefSizes:
    """A square."""

    side_m: float = 0.3

    def __post_init__(self) -> None:
        """Check the length; see `_check_lengths`."""
        _check_lengths(self)

    def outline(self) -> Outline:
        """Its four corners, from the lower left one."""
        half = self.side_m / 2
        corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
        names = ("corner_lower_left", "corner_lower_right", "corner_upper_right")
        return Outline(
            np.array(corners),
            dict(zip((*names, "corner_upper_left"), corners, strict=True)),
        )


@dataclass(frozen=True)
class ShirtSizes:
    """A shirt with two sleeves; the defaults have long ones, `TSHIRT` has short ones."""

    body_width_m: float = 0.22
    body_length_m: float = 0.40
    shoulder_width_m: float = 0.20
    sleeve_length_m: float = 0.20
    """From the shoulder's tip to the cuff, along the upper edge."""

    sleeve_width_m: float = 0.075
    """At the cuff."""

    sleeve_angle_rad: float = pi / 4
    """How far the sleeve points downwards, from straight to the side."""

    neck_width_m: float = 0.09
    neck_depth_m: float = 0.02

    def __post_init__(self) -> None:
        """Check that the lengths make an outline that does not cross itself.

        Raises:
            ValueError: a length is not positive, or two do not go together.
        """
        _check_lengths(self)
        if not -0.2 <= self.sleeve_angle_rad <= 1.2:
            raise ValueError(
                f"ShirtSizes.sleeve_angle_rad: expected -0.2 to 1.2; got {self.sleeve_angle_rad}; "
                f"the default is {pi / 4:.3f}"
            )
        if not self.neck_width_m < self.shoulder_width_m <= self.body_width_m:
            raise ValueError(
                "ShirtSizes: expected neck_width_m < shoulder_width_m <= body_width_m; got "
                f"{self.neck_width_m}, {self.shoulder_width_m}, {self.body_width_m}; "
                "narrow the neck or widen the body"
            )
        armpit_m, reach_m = self._armpit_m(), self._cuff_m()[1][0]
        if not 0.05 * self.body_length_m < armpit_m + self.body_length_m / 2:
            raise ValueError(
                "ShirtSizes: expected armpits above the hem; got them "
                f"{armpit_m + self.body_length_m / 2:.3f} m over it; lengthen the body, or make "
                "the sleeves narrower or less steep"
            )
        if not reach_m > self.body_width_m / 2 + 0.01:
            raise ValueError(
                "ShirtSizes: expected sleeves that reach beyond the body; got "
                f"{reach_m:.3f} m of {self.body_width_m / 2} m; lengthen the sleeves"
            )

    def outline(self) -> Outline:
        """Thirteen corners, counter-clockwise from the right end of the hem."""
        half, hem, top = self.body_width_m / 2, -self.body_length_m / 2, self.body_length_m / 2
        upper, lower = self._cuff_m()
        right = [
            (half, hem),
            (half, self._armpit_m()),
            lower,
            upper,
            (self.shoulder_width_m / 2, top),
            (self.neck_width_m / 2, top),
        ]
        left = [(-x, y) for x, y in reversed(right)]
        cuff = ((upper[0] + lower[0]) / 2, (upper[1] + lower[1]) / 2)
        one_side = {"hem": right[0], "armpit": right[1], "sleeve": cuff, "shoulder": right[4]}
        keypoints = {f"{name}_right": point for name, point in one_side.items()}
        keypoints |= {f"{name}_left": (-x, y) for name, (x, y) in one_side.items()}
        collar = (0.0, top - self.neck_depth_m)
        return Outline(np.array([*right, collar, *left]), keypoints | {"collar": collar})

    def _cuff_m(self) -> tuple[Point, Point]:
        """The right cuff's upper and lower end."""
        down = self.sleeve_angle_rad
        x = self.shoulder_width_m / 2 + self.sleeve_length_m * cos(down)
        y = self.body_length_m / 2 - self.sleeve_length_m * sin(down)
        return (x, y), (x - self.sleeve_width_m * sin(down), y - self.sleeve_width_m * cos(down))

    def _armpit_m(self) -> float:
        """Where the sleeve's lower edge, parallel to the upper one, meets the body."""
        x, y = self._cuff_m()[1]
        return y + (x - self.body_width_m / 2) * sin(self.sleeve_angle_rad) / cos(
            self.sleeve_angle_rad
        )


@dataclass(frozen=True)
class TrousersSizes:
    """Trousers with two straight legs."""

    waist_width_m: float = 0.21
    length_m: float = 0.47
    leg_length_m: float = 0.32
    """From the hem to the crotch."""

    leg_width_m: float = 0.09
    """At the hem."""

    hem_spread_m: float = 0.12
    """From the middle to a leg's outer end at the hem."""

    def __post_init__(self) -> None:
        """Check that the lengths make an outline that does not cross itself.

        Raises:
            ValueError: a length is not positive, or two do not go together.
        """
        _check_lengths(self)
        if not self.leg_width_m < self.hem_spread_m:
            raise ValueError(
                "TrousersSizes: expected leg_width_m < hem_spread_m; got "
                f"{self.leg_width_m}, {self.hem_spread_m}; the legs would cross"
            )
        if not self.leg_length_m < 0.9 * self.length_m:
            raise ValueError(
                "TrousersSizes: expected leg_length_m < 0.9 * length_m; got "
                f"{self.leg_length_m}, {self.length_m}; nothing would join the legs"
            )

    def outline(self) -> Outline:
        """Seven corners, counter-clockwise from the left leg's outer end."""
        hem, top = -self.length_m / 2, self.length_m / 2
        inner, crotch = self.hem_spread_m - self.leg_width_m, (0.0, hem + self.leg_length_m)
        outer = {"hem": (self.hem_spread_m, hem), "waist": (self.waist_width_m / 2, top)}
        keypoints = {f"{name}_right": point for name, point in outer.items()}
        keypoints |= {f"{name}_left": (-x, y) for name, (x, y) in outer.items()}
        corners = [
            keypoints["hem_left"],
            (-inner, hem),
            crotch,
            (inner, hem),
            keypoints["hem_right"],
            keypoints["waist_right"],
            keypoints["waist_left"],
        ]
        return Outline(np.array(corners), keypoints | {"crotch": crotch})


def _check_lengths(sizes: HandkerchiefSizes | ShirtSizes | TrousersSizes) -> None:
    for field in fields(sizes):
        value = getattr(sizes, field.name)
        if field.name.endswith("_m") and not 0.005 <= value <= 1.0:
            raise ValueError(
                f"{type(sizes).__name__}.{field.name}: expected 0.005 to 1 m; got {value}; "
                f"the default is {field.default}"
            )


TSHIRT = ShirtSizes(
    body_width_m=0.224,
    body_length_m=0.384,
    shoulder_width_m=0.21,
    sleeve_length_m=0.12,
    sleeve_width_m=0.095,
    sleeve_angle_rad=0.5,
)
"""Under the t-shirt task's camera its hem lies at the source's initial points (algorithm 3)."""
