"""The experiments of chapter 4."""

from __future__ import annotations

from typing import Final

from deploy.reproduce.chapter3 import ADAM
from deploy.reproduce.experiment import Condition, Experiment, Panel

_IMITATION_NOTES = (
    "30 steps an episode: with the 20 of table 4.1b no policy reaches the target.",
    "Demonstrations: five episodes of the script with mistakes, where the source takes policies "
    "under training; targets are the demonstrated states nearer than 0.1.",
    "Adam instead of RMSProp, and K's 20 epochs with a target switch after every fourth: with one "
    "after each, preferences diverged in a trial (PGAIL-BiD, seed 0: greedy return -18.3 after six "
    "iterations, loss 1,600 and -57.9 after eight).",
)
_SETTINGS = (*ADAM, "schedule.target_switches=5", "schedule.epochs=4")


def _imitating(name: str, label: str, colour: str, generator: str, which: str) -> Condition:
    overrides = [f"algorithm.method={generator}", f"imitation.discriminators={which}"]
    overrides += ["algorithm.sigma=0.0"] if generator == "dqn" else []
    return Condition(name, label, colour, tuple(overrides))


BID: Final = _imitating("pgail-bid", "PGAIL-BiD", "C2", "edpn", "both")
PGAIL: Final = _imitating("pgail", "PGAIL (D_E only)", "C0", "edpn", "expert")
TARGET_ONLY: Final = _imitating("pgail-target", "D_T only", "C4", "edpn", "target")
QGAIL_BID: Final = _imitating("qgail-bid", "QGAIL-BiD", "C3", "dqn", "both")
QGAIL: Final = _imitating("qgail", "QGAIL (D_E only)", "C1", "dqn", "expert")
CLONING: Final = Condition(
    "cloning",
    "behaviour cloning",
    "C7",
    ("algorithm.method=dpn", "algorithm.sigma=0.0"),
    start="cloned",
)

CHAPTER_4: Final = (
    Experiment(
        name="figure-4.5",
        title="Figure 4.5: imitation of imperfect demonstrations",
        source="figure 4.5",
        published="PGAIL-BiD reaches the demonstrations' performance or passes it at every "
        "quality; PGAIL, QGAIL-BiD and QGAIL stay at or below it.",
        preset="reaching-ch4-horizon30",
        overrides=_SETTINGS,
        panels=(
            Panel(
                "20 % mistakes",
                (BID, PGAIL, QGAIL_BID, QGAIL, CLONING),
                seeds=5,
                mistake_rate=0.2,
            ),
        ),
        notes=_IMITATION_NOTES,
    ),
    Experiment(
        name="figure-4.6",
        title="Figure 4.6: both discriminators, and each alone",
        source="figure 4.6",
        published="With both, the policy is above the expert after four iterations and stays; with "
        "D_E alone it passes the expert, then declines; with D_T alone it passes it, then sticks.",
        preset="reaching-ch4-horizon30",
        overrides=_SETTINGS,
        panels=(Panel("20 % mistakes", (BID, PGAIL, TARGET_ONLY), seeds=5, mistake_rate=0.2),),
        notes=_IMITATION_NOTES,
    ),
)
