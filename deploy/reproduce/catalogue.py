"""The experiments that `clothbus reproduce` knows: the source's figures, and some beside them."""

from __future__ import annotations

from typing import Final

from broker_config.errors import PresetError
from deploy.reproduce.chapter3 import ATTENTION_OF_CHAPTER_3, CHAPTER_3
from deploy.reproduce.chapter4 import ATTENTION_OF_CHAPTER_4, CHAPTER_4, TRANSFER_OF_CHAPTER_4
from deploy.reproduce.experiment import AttentionFigure, Experiment, TransferTable

EXPERIMENTS: Final = {experiment.name: experiment for experiment in (*CHAPTER_3, *CHAPTER_4)}
ATTENTION_FIGURES: Final = {
    figure.name: figure for figure in (*ATTENTION_OF_CHAPTER_3, *ATTENTION_OF_CHAPTER_4)
}
TRANSFER_TABLES: Final = {table.name: table for table in TRANSFER_OF_CHAPTER_4}


def find(name: str) -> Experiment | AttentionFigure | TransferTable:
    """An experiment, or what is made of the policies that experiments have left, by its name.

    Raises:
        PresetError: There is none of that name.
    """
    return ATTENTION_FIGURES.get(name) or TRANSFER_TABLES.get(name) or find_experiment(name)


def find_experiment(name: str) -> Experiment:
    """An experiment by its name.

    Raises:
        PresetError: There is none of that name.
    """
    if name not in EXPERIMENTS:
        names = ", ".join(sorted([*EXPERIMENTS, *ATTENTION_FIGURES, *TRANSFER_TABLES]))
        raise PresetError(f"reproduce: expected one of {names}; got {name}; choose one")
    return EXPERIMENTS[name]
