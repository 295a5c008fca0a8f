"""Spreads crumpled cloth by pick and drop until it lies flat: the automatic reset.

Source: chapter 5.2.2, which wishes for one. Neither policy nor simulator: what is known is the
camera's picture, the camera, and how much the spread garment covers. The cloth counts as spread
whichever side is up, unless one is asked for; then it is turned over where need be.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from actors.cloth.camera import Camera
from actors.cloth.masks import Side, cloth_mask, side_masks
from actors.cloth.measures import normalised_coverage
from actors.cloth.pick_points import NoClothInViewError
from actors.cloth.pulls import (
    Pull,
    PullKind,
    centring_pull,
    spreading_pulls,
    touches_border,
    turning_pull,
)

Point = tuple[float, float]
OnPull = Callable[[Pull, Camera], None]
"""Takes a pull and the camera in whose pixels it speaks."""

DROP_MARGIN: Final = 0.06
"""Portion of the picture's width that drop points keep from its border."""

PROGRESS: Final = 0.02
"""Normalised coverage below which a pull brought nothing."""

LIKE_PICK, LIKE_DROP = 0.05, 0.12
"""Portions of the picture's width within which two pulls are alike."""

TRIED_IN_VAIN: Final = 0.3
"""Portion of the hidden area that a pull promises less for each like it that brought nothing."""

LUCK: Final = 0.05
"""Portion of the hidden area that is drawn at random, for each pull that brought nothing and one
more: it first decides between equal promises, then leads out of a circle."""

MOST_LUCK: Final = 0.3


class TableLostError(RuntimeError):
    """A table cannot go on: a robot stopped to protect itself, or a simulated cloth broke."""


class HandAndEye(Protocol):
    """A table with cloth, as a robot has it."""

    def look(self) -> NDArray[np.uint8]:
        """The camera's picture, u8[H, H, 3], with the hand out of the way."""
        ...

    def pick_and_drop(self, pick_xy_m: Point, drop_xy_m: Point) -> bool:
        """Take the cloth at a point of the table, lift, carry, drop it.

        Returns:
            Whether it was done; False where the hand cannot reach, so that another way is tried.

        Raises:
            NoClothInViewError: the cloth has left the picture.
            TableLostError: the table cannot go on.
        """
        ...


class SpreadEnd(StrEnum):
    """Why spreading ended."""

    SPREAD = "spread"
    """The cloth is flat and in the middle."""

    OUT_OF_ACTIONS = "out_of_actions"
    """As many actions were spent as were allowed."""

    NO_CLOTH_IN_VIEW = "no_cloth_in_view"
    """A person must put the cloth back."""

    TABLE_LOST = "table_lost"
    """A person must see what happened."""


@dataclass(frozen=True)
class SpreadAim:
    """When cloth is spread, and when to give up."""

    coverage: float = 0.94
    """Least normalised coverage, by the picture."""

    up: Side | None = None
    """Which side must be up; None where either will do."""

    off_middle_m: float = 0.05
    """The most that its centroid may lie off the table's middle."""

    actions: int = 25
    """The most that are spent."""

    def __post_init__(self) -> None:
        """Check each number.

        Raises:
            ValueError: one is out of its rule.
        """
        if self.up not in (None, "green", "red"):
            raise ValueError(
                f"SpreadAim.up: expected None, 'green' or 'red'; got {self.up!r}; None leaves it "
                "to chance"
            )
        if not 0.0 < self.coverage <= 1.0:
            raise ValueError(
                f"SpreadAim.coverage: expected a portion above 0, at most 1; got {self.coverage}; "
                "0.94 is usual"
            )
        if not self.off_middle_m > 0.0 or self.actions < 0:
            raise ValueError(
                "SpreadAim: expected a positive off_middle_m and actions of at least 0; got "
                f"{self.off_middle_m} and {self.actions}; 0.05 and 25 are usual"
            )


@dataclass(frozen=True)
class Spread:
    """What came of it."""

    coverage: float
    """Normalised, by the last picture."""

    actions: int
    end: SpreadEnd


@dataclass
class SpreadingRule:
    """Chooses pulls one by one, and remembers which brought nothing."""

    camera: Camera
    flat_px: int
    """Pixels of the camera's picture that the spread garment covers."""

    random: np.random.Generator
    """Decides between pulls that promise the same."""

    aim: SpreadAim = field(default_factory=SpreadAim)
    _best: float = field(default=0.0, init=False)
    _last: Pull | None = field(default=None, init=False)
    _in_vain: list[Pull] = field(default_factory=list, init=False)

    def next_pull(self, picture: NDArray[np.uint8]) -> Pull | None:
        """What to do now, with its drop point within the picture; None where the cloth is spread.

        Args:
            picture: u8[H, H, 3], of the rule's camera.

        Raises:
            ValueError: it is no such picture.
            NoClothInViewError: it shows no cloth.
        """
        mask = self._checked_mask(picture)
        coverage = normalised_coverage(mask, self.flat_px)
        self._remember(coverage)
        is_spread = coverage >= self.aim.coverage
        if is_spread and self._is_wrong_side_up(picture):
            self._best, self._in_vain = 0.0, []
            chosen = turning_pull(mask, int(self.random.integers(4)))
        elif touches_border(mask) or (is_spread and not self._is_centred(mask)):
            chosen = centring_pull(mask, self._pixel((0.0, 0.0)))
        elif is_spread:
            return None
        else:
            chosen = self._most_promising(
                spreading_pulls(picture, self.flat_px, self.aim.up), coverage
            )
        chosen = self._within_reach(chosen)
        self._last = chosen
        return chosen

    def _remember(self, coverage: float) -> None:
        if coverage >= self._best + PROGRESS:
            self._best, self._in_vain = coverage, []
        elif self._last is not None and self._last.kind in (PullKind.UNFOLD, PullKind.STRETCH):
            self._in_vain.append(self._last)

    def _is_wrong_side_up(self, picture: NDArray[np.uint8]) -> bool:
        """Whether the picture shows more of the side that must not be up."""
        seen_px = {side: int(seen.sum()) for side, seen in side_masks(picture).items()}
        return self.aim.up is not None and 2 * seen_px[self.aim.up] < sum(seen_px.values())

    def _pixel(self, xy_m: Point) -> Point:
        x, y = self.camera.project_px(np.array([*xy_m, 0.0])).tolist()
        return x, y

    def _most_promising(self, pulls: list[Pull], coverage: float) -> Pull:
        hidden_px = (1.0 - coverage) * self.flat_px
        doubt_px = TRIED_IN_VAIN * hidden_px
        luck = min(MOST_LUCK, LUCK * (1 + len(self._in_vain)))
        lucky_px = self.random.uniform(0.0, luck * hidden_px, len(pulls))
        return max(
            zip(pulls, lucky_px, strict=True),
            key=lambda it: it[0].promise_px + it[1] - doubt_px * self._times_in_vain(it[0]),
        )[0]

    def _times_in_vain(self, pull: Pull) -> int:
        size, drop_px = self.camera.size_px, self._within_reach(pull).drop_px
        return sum(
            _distance(pull.pick_px, tried.pick_px) < LIKE_PICK * size
            and _distance(drop_px, tried.drop_px) < LIKE_DROP * size
            for tried in self._in_vain
        )

    def _within_reach(self, pull: Pull) -> Pull:
        size = self.camera.size_px
        least, most = DROP_MARGIN * size, (1 - DROP_MARGIN) * size
        x, y = np.clip(pull.drop_px, least, most).tolist()
        return Pull(pull.kind, pull.pick_px, (x, y), pull.promise_px)

    def _is_centred(self, mask: NDArray[np.bool_]) -> bool:
        rows, columns = np.nonzero(mask)
        x_m, y_m = self.camera.table_point_m((columns.mean() + 0.5, rows.mean() + 0.5))
        return bool(np.hypot(x_m, y_m) <= self.aim.off_middle_m)

    def _checked_mask(self, picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
        mask = cloth_mask(picture)
        size = self.camera.size_px
        if mask.shape != (size, size):
            raise ValueError(
                f"picture: expected uint8 [{size}, {size}, 3], as the camera takes; got "
                f"{list(picture.shape)}; give the rule the calibration of the camera in use"
            )
        return mask


def spread(
    table: HandAndEye,
    camera: Camera,
    flat_px: int,
    random: np.random.Generator,
    aim: SpreadAim | None = None,
    on_pull: OnPull | None = None,
) -> Spread:
    """Spread what lies on the table, and bring it back to the middle.

    Args:
        table: what sees and acts, in a simulator or at a robot.
        camera: that takes the pictures.
        flat_px: pixels of a picture that the spread garment covers in the table's middle.
        random: decides between pulls that promise the same.
        aim: when to stop.
        on_pull: is told of each pull before it is made.

    Raises:
        ValueError: a picture is not the camera's, or the flat garment covers nothing.
    """
    rule = SpreadingRule(camera, flat_px, random, aim or SpreadAim())
    actions, coverage = 0, 0.0
    while True:
        try:
            picture = table.look()
            coverage = normalised_coverage(cloth_mask(picture), flat_px)
            pull = rule.next_pull(picture)
            if pull is None:
                return Spread(coverage, actions, SpreadEnd.SPREAD)
            if actions == rule.aim.actions:
                return Spread(coverage, actions, SpreadEnd.OUT_OF_ACTIONS)
            pick, drop = camera.table_point_m(pull.pick_px), camera.table_point_m(pull.drop_px)
            actions += 1
            if on_pull is not None:
                on_pull(pull, camera)
            table.pick_and_drop(pick, drop)
        except NoClothInViewError:
            return Spread(0.0, actions, SpreadEnd.NO_CLOTH_IN_VIEW)
        except TableLostError:
            return Spread(coverage, actions, SpreadEnd.TABLE_LOST)


def _distance(a: Point, b: Point) -> float:
    return float(np.hypot(a[0] - b[0], a[1] - b[1]))
