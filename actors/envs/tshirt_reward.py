"""Algorithm 3: the reward of t-shirt folding, from markers in the picture.

As printed the functions' names and the two tests are swapped: the sleeves' distance is tested by
the hem's marker and the other way round, and called by the other's name. Corrected, the sleeves
come first and then the hem; the literal form stays selectable. Distances are sums over both
coordinates of absolute differences, in portions of the picture.
"""

from collections.abc import Mapping
from typing import Final, Literal

Point = tuple[float, float]
RewardForm = Literal["corrected", "literal"]

INITIAL_HEMS: Final[Mapping[str, Point]] = {"hem_right": (0.675, 0.8), "hem_left": (0.325, 0.8)}
TARGET_HEMS: Final[Mapping[str, Point]] = {"hem_right": (0.675, 0.208), "hem_left": (0.325, 0.208)}
SLEEVES: Final = ("sleeve_right", "sleeve_left")
NEAR_BORDER: Final = 0.06
"""A marker that was last seen so near to the picture's border has left it; it is not covered."""


class TshirtReward:
    """The reward of one episode; it remembers where markers were last seen."""

    def __init__(self, form: RewardForm = "corrected") -> None:
        """Begin an episode.

        Args:
            form: "corrected", or "literal" as the algorithm is printed.

        Raises:
            ValueError: it is neither.
        """
        if form not in ("corrected", "literal"):
            raise ValueError(
                f"reward_form: expected 'corrected' or 'literal'; got {form!r}; choose one of them"
            )
        self._form: RewardForm = form
        self._last_seen: dict[str, Point] = dict(INITIAL_HEMS)

    def __call__(self, seen: Mapping[str, Point]) -> float:
        """The reward of a state.

        Args:
            seen: where markers are seen, by name; see `actors.cloth.markers.found_markers`.
        """
        self._last_seen |= seen
        if self._form == "literal":
            hem_seen = any(name in seen for name in TARGET_HEMS)
            sleeve_seen = any(name in seen for name in SLEEVES)
            reward = self._sleeves(SLEEVES) if hem_seen else 1.0
            return reward + (self._hems() if sleeve_seen else 0.0)
        out = [name for name in SLEEVES if name in seen or self._left_the_picture(name)]
        return self._sleeves(tuple(out)) if out else 1.0 + self._hems()

    def sleeves_folded(self, seen: Mapping[str, Point]) -> bool:
        """Whether both sleeves are folded in: neither seen, nor gone beyond the border."""
        return not any(name in seen or self._left_the_picture(name) for name in SLEEVES)

    def _sleeves(self, names: tuple[str, ...]) -> float:
        """-sum |sleeve - centre of the hem|, over sleeves where they are or were last seen."""
        right, left = (self._last_seen[name] for name in ("hem_right", "hem_left"))
        centre = ((right[0] + left[0]) / 2, (right[1] + left[1]) / 2)
        seen_once = [self._last_seen[name] for name in names if name in self._last_seen]
        return -sum((_distance(sleeve, centre) for sleeve in seen_once), 0.0)

    def _hems(self) -> float:
        """sum(|initial - target| - |hem - target|) over both ends of the hem."""
        return sum(
            _distance(INITIAL_HEMS[name], target) - _distance(self._last_seen[name], target)
            for name, target in TARGET_HEMS.items()
        )

    def _left_the_picture(self, name: str) -> bool:
        if name not in self._last_seen:
            return False
        return min(*self._last_seen[name], *(1 - c for c in self._last_seen[name])) < NEAR_BORDER


def _distance(one: Point, two: Point) -> float:
    return abs(one[0] - two[0]) + abs(one[1] - two[1])
