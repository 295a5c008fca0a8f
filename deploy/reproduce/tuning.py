"""Chapter 3's methods with settings of their own: what is tried for each.

Every method has the same budget: the same number of settings, tried on the same seeds, none of
which is reported. The choice is the setting with the largest mean area under the curve of the
greedy return.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

from deploy.reproduce.experiment import Condition, Panel

FIRST_TUNING_SEED: Final = 100
N_TUNING_SEEDS: Final = 2

_RATES: Final = ("2.5e-4", "1e-3")
_INTERVALS: Final = ((2, 2), (4, 1))
INTERVALS_OF_FULL_REPLAY: Final = ((2, 1), (1, 2))
"""Half as many passes, over a memory that grows to five times the size."""
ETAS: Final = tuple((f"eta {it}", f"algorithm.eta={it}.0") for it in (1, 5))
"""For the softmax policy a larger one is a larger scale of the rewards."""
DECAYS: Final = tuple((f"decay {it}", f"exploration.decay_episodes={it}") for it in (35, 15))
"""Episodes over which epsilon falls."""

TUNING_NOTES: Final = (
    f"Seeds {FIRST_TUNING_SEED} to {FIRST_TUNING_SEED + N_TUNING_SEEDS - 1}, which no figure "
    "reports. Every method has eight settings: two learning rates, two target intervals with the "
    "same number of gradient steps, and two values of eta (for the softmax policy the scale of the "
    "rewards), or for DQN of the episodes over which epsilon falls.",
    "The choice looks at greedy policies, which do not pay for exploration. Full replay makes 1.4 "
    "times as many gradient steps as the others.",
)


@dataclass(frozen=True)
class Tuned:
    """A method, and what is tried for it beside learning rates."""

    method: Condition
    own: tuple[tuple[str, str], ...]
    """Of a setting that not all methods have: label and override of each value."""
    intervals: tuple[tuple[int, int], ...] = _INTERVALS
    """Target switches of an update and epochs before each; the same number of gradient steps."""

    def settings(self) -> Iterator[Condition]:
        """All that is tried."""
        tried = product(_RATES, self.intervals, self.own)
        for number, (rate, (switches, epochs), (own, override)) in enumerate(tried):
            yield replace(
                self.method,
                name=f"{self.method.name}-rate-{rate}-switches-{switches}-{own.replace(' ', '-')}",
                label=f"rate {rate}, {switches} x {epochs} epochs, {own}",
                colour=f"C{number}",
                overrides=(
                    *self.method.overrides,
                    f"optimiser.learning_rate={rate}",
                    f"schedule.target_switches={switches}",
                    f"schedule.epochs={epochs}",
                    override,
                ),
            )

    def panel(self) -> Panel:
        """All that is tried, on seeds that are not reported."""
        return Panel(
            f"{self.method.label}, tried",
            tuple(self.settings()),
            seeds=N_TUNING_SEEDS,
            first_seed=FIRST_TUNING_SEED,
            tries_settings=True,
        )
