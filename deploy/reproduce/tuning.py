"""Chapter 3's methods with settings of their own: what is tried for each.

Every method has the same budget: the same number of settings, tried on the same seeds, none of
which is reported. The choice will be the setting with the largest mean area under the curve of the
greedy return. None has been made yet.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Final

from deploy.reproduce.experiment import Condition, Panel

FIRST_TUNING_SEED: Final = 100
N_TUNING_SEEDS: Final = 2

_RATES: Final = ("2.5e-4", "1e-3")
_INTERVALS: Final = ((2, 2), (4, 1))
"""Target switches of an update and epochs before each: the same number of gradient steps."""
_ETAS: Final = (1, 5)
"""Of DPN; for its softmax policy a larger one is a larger scale of the rewards."""
_DECAYS: Final = (35, 15)
"""Episodes over which DQN's epsilon falls."""

TUNING_NOTES: Final = (
    f"Seeds {FIRST_TUNING_SEED} to {FIRST_TUNING_SEED + N_TUNING_SEEDS - 1}, which no figure "
    "reports. Every method has eight settings: two learning rates, two target intervals with the "
    "same number of gradient steps, and two values of eta (for the softmax policy the scale of the "
    "rewards), or for DQN of the episodes over which epsilon falls.",
    "A method's choice is the setting with the largest mean area under its curve.",
)


def tuning_panel(method: Condition) -> Panel:
    """All settings of a method, tried on seeds that are not reported."""
    return Panel(
        f"{method.label}, tried",
        tuple(_settings_of(method)),
        seeds=N_TUNING_SEEDS,
        first_seed=FIRST_TUNING_SEED,
    )


def _settings_of(method: Condition) -> Iterator[Condition]:
    is_dqn = "algorithm.method=dqn" in method.overrides
    own = (
        [("decay", it, f"exploration.decay_episodes={it}") for it in _DECAYS]
        if is_dqn
        else [("eta", it, f"algorithm.eta={it}.0") for it in _ETAS]
    )
    tried = product(_RATES, _INTERVALS, own)
    for number, (rate, (switches, epochs), (what, value, override)) in enumerate(tried):
        yield replace(
            method,
            name=f"{method.name}-rate-{rate}-switches-{switches}-{what}-{value}",
            label=f"rate {rate}, {switches} switches, {what} {value}",
            colour=f"C{number}",
            overrides=(
                *method.overrides,
                f"optimiser.learning_rate={rate}",
                f"schedule.target_switches={switches}",
                f"schedule.epochs={epochs}",
                override,
            ),
        )
