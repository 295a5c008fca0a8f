"""The presets that come with clothbus: one for each table of the source, and a few more."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import resources
from pathlib import Path

from broker_config.errors import PresetError
from broker_config.preset import Preset, preset_from_toml


def preset_names() -> list[str]:
    """The names that `load_preset` knows."""
    files = resources.files(__name__).iterdir()
    return sorted(file.name[:-5] for file in files if file.name.endswith(".toml"))


def preset_text(name: str) -> str:
    """The TOML text of a preset, by its name or by a file's path.

    Raises:
        PresetError: There is neither.
    """
    if name in preset_names():
        return resources.files(__name__).joinpath(f"{name}.toml").read_text()
    path = Path(name)
    if path.suffix == ".toml" and path.is_file():
        return path.read_text()
    raise PresetError(
        f"preset {name}: expected the path of a .toml file or one of {', '.join(preset_names())}; "
        "run `clothbus presets` to see what each is"
    )


def load_preset(name: str, overrides: Iterable[str] = ()) -> Preset:
    """Loads a preset by its name or path.

    Args:
        name: One of `preset_names`, or the path of a TOML file.
        overrides: Settings that replace the file's: `schedule.iterations=3`.

    Raises:
        PresetError: It does not exist or cannot be used.
    """
    return preset_from_toml(preset_text(name), overrides)
