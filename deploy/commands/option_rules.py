"""What several commands' options have in common: their names, and what they must be."""

from __future__ import annotations

from typing import Annotated, Final

import tyro

from broker_config.errors import PresetError
from broker_config.preset import Preset

SHORTEST_HUNG_SECS: Final = 10.0

Settings = Annotated[tuple[str, ...], tyro.conf.arg(name="set")]
"""Settings that replace the preset's."""


def refuse_unknown_task(preset: Preset) -> None:
    """Refuses a preset whose task this version does not have.

    Raises:
        PresetError: There is no such task.
    """
    from actors.envs import ENV_IDS

    if preset.task.environment not in ENV_IDS:
        raise PresetError(
            f"{preset.name}: expected a task of {', '.join(ENV_IDS)}; got "
            f"{preset.task.environment}; this version does not have it"
        )


def require_positive(option: str, value: int) -> None:
    """Refuses what is no count of at least one.

    Raises:
        PresetError: The value is below 1.
    """
    if value < 1:
        raise PresetError(f"--{option}: expected at least 1; got {value}")


def require_patience(hung_secs: float) -> None:
    """Refuses to take a process for hung that only waits for its turn.

    Raises:
        PresetError: The time is too short.
    """
    if not hung_secs >= SHORTEST_HUNG_SECS:
        raise PresetError(
            f"--hung-secs: expected at least {SHORTEST_HUNG_SECS:g}; got {hung_secs:g}; in a "
            "shorter time a busy machine stands still by itself"
        )
