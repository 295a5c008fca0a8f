"""The experiments that `clothbus reproduce` knows: the source's figures, and some beside them."""

from __future__ import annotations

from typing import Final

from broker_config.errors import PresetError
from deploy.reproduce.chapter3 import ATTENTION_OF_CHAPTER_3, CHAPTER_3
from deploy.reproduce.chapter4 import CHAPTER_4
from deploy.reproduce.experiment import AttentionFigure, Experiment

EXPERIMENTS: Final = {experiment.name: experiment for experiment in (*CHAPTER_3, *CHAPTER_4)}
ATTENTION_FIGURES: Final = {figure.name: figure for figure in ATTENTION_OF_CHAPTER_3}


def find(name: str) -> Experiment | AttentionFigure:
    """An experiment, or a figure of one's policies, by its name.

    Raises:
        PresetError: There is none of that name.
    """
    found = EXPERIMENTS.get(name) or ATTENTION_FIGURES.get(name)
    if found is None:
        names = ", ".join(sorted([*EXPERIMENTS, *ATTENTION_FIGURES]))
        raise PresetError(f"reproduce: expected one of {names}; got {name}; choose one")
    return found
