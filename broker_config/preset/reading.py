"""Presets from text: a person's TOML, JSON that travels, settings on a command line."""

from __future__ import annotations

import dataclasses
import json
import tomllib
from collections.abc import Iterable

from broker_config.errors import MessageError, PresetError
from broker_config.preset.experiment import Preset
from broker_config.structure import from_plain


def preset_from_json(text: str) -> Preset:
    """Reads what `Preset.to_json` wrote.

    Raises:
        PresetError: The text is not a preset of this version.
    """
    try:
        return from_plain(json.loads(text), Preset, "preset")
    except ValueError as error:
        raise PresetError(f"preset: {error}") from error


def with_settings(preset: Preset, overrides: Iterable[str]) -> Preset:
    """The preset with other settings.

    Args:
        preset: Whose others stay.
        overrides: As for `preset_from_toml`.

    Raises:
        PresetError: A setting is unknown, or a value out of range.
    """
    table = json.loads(preset.to_json())
    try:
        for override in overrides:
            _apply(table, override)
        return from_plain(table, Preset, "preset")
    except MessageError as error:
        raise PresetError(str(error)) from error


def preset_from_toml(text: str, overrides: Iterable[str] = ()) -> Preset:
    """Reads a preset file.

    Args:
        text: The TOML text.
        overrides: Settings that replace the file's, each as `schedule.iterations=3` with a TOML
            value on the right.

    Raises:
        PresetError: The text is no TOML, or a value is missing, unknown or out of range.
    """
    try:
        table = tomllib.loads(text)
        for override in overrides:
            _apply(table, override)
        return from_plain(table, Preset, "preset")
    except (tomllib.TOMLDecodeError, MessageError) as error:
        raise PresetError(str(error)) from error


def _apply(table: dict[str, object], override: str) -> None:
    path, separator, literal = override.partition("=")
    if not separator:
        raise PresetError(
            f"override {override!r}: expected KEY=VALUE; write for example schedule.iterations=3"
        )
    *parents, name = path.strip().split(".")
    for parent in parents:
        child = table.setdefault(parent, {})
        if not isinstance(child, dict):
            raise PresetError(f"override {override!r}: {parent} is a value, not a table")
        table = child
    table[name] = toml_value(literal.strip())


def toml_value(literal: str) -> object:
    """What is written after `key=` on a command line: a TOML value, or else plain text."""
    try:
        return tomllib.loads(f"value = {literal}")["value"]
    except tomllib.TOMLDecodeError:
        return literal


def with_seed(preset: Preset, seed: int) -> Preset:
    """The same experiment on another seed."""
    return dataclasses.replace(preset, seed=seed)
