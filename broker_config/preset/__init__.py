"""The preset: every choice of an experiment, as one frozen value with a digest.

A preset is written as TOML; `deploy/presets` holds one for each table of the source. Both ends of
the bus compare its digest before they work together.
"""

from broker_config.preset.experiment import Preset
from broker_config.preset.imitation import DiscriminatorPreset, ImitationPreset
from broker_config.preset.reading import (
    preset_from_json,
    preset_from_toml,
    toml_value,
    with_seed,
    with_settings,
)
from broker_config.preset.tables import (
    AlgorithmPreset,
    AugmentationPreset,
    ExplorationPreset,
    InitialisationPreset,
    OptimiserPreset,
    SchedulePreset,
    TaskOption,
    TaskPreset,
)

__all__ = [
    "AlgorithmPreset",
    "AugmentationPreset",
    "DiscriminatorPreset",
    "ExplorationPreset",
    "ImitationPreset",
    "InitialisationPreset",
    "OptimiserPreset",
    "Preset",
    "SchedulePreset",
    "TaskOption",
    "TaskPreset",
    "preset_from_json",
    "preset_from_toml",
    "toml_value",
    "with_seed",
    "with_settings",
]
