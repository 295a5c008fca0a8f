"""Named difficulties of the cloth tasks: what a result must say to be compared with another.

Frozen on 2026-11-22, before any learner was run on them. `clothbus task ID --set difficulty=NAME`
prints what the scripted expert and random play achieve; at the medium one, which is the default,
the expert succeeds in at least 95 % of episodes, and chance flips at most 10 % of handkerchiefs.
"""

from collections.abc import Mapping
from typing import Any, Final, Literal, get_args

Difficulty = Literal["easy", "medium", "hard"]
DIFFICULTIES: Final[tuple[Difficulty, ...]] = get_args(Difficulty)

Options = Mapping[str, Any]
"""Of `ClothTaskOptions`."""

FLIPPING: Final[Mapping[Difficulty, Options]] = {
    "easy": {},
    "medium": {"start_shift_m": 0.01, "start_turn_rad": 0.1},
    "hard": {"start_shift_m": 0.03, "start_turn_rad": 0.5},
}
"""Of a handkerchief of 0.3 m: for a larger one chance flips more often, see docs/tasks.md."""

FOLDING: Final[Mapping[Difficulty, Options]] = {
    "easy": {},
    "medium": {"start_shift_m": 0.01, "start_turn_rad": 0.1},
    "hard": {"start_shift_m": 0.03, "start_turn_rad": 0.5},
}
"""Along lines, which follow the outline."""

TSHIRT: Final[Mapping[Difficulty, Options]] = {
    "easy": {},
    "medium": {"start_shift_m": 0.01, "start_turn_rad": 0.1},
    "hard": {"start_shift_m": 0.02, "start_turn_rad": 0.2},
}
"""By drop points that do not follow the garment."""


def check_difficulty(name: str) -> None:
    """Check a name.

    Raises:
        ValueError: there is no such difficulty.
    """
    if name not in DIFFICULTIES:
        raise ValueError(
            f"difficulty: expected one of {', '.join(DIFFICULTIES)}; got {name!r}; name one of them"
        )
