"""The cloth engines by name."""

from collections.abc import Callable, Mapping
from typing import Any

from actors.cloth.engine import ClothEngine
from actors.cloth.pybullet_process import PyBulletProcessEngine
from actors.cloth.pybullet_settings import PyBulletSettings
from actors.cloth.xpbd_engine import XpbdEngine
from actors.cloth.xpbd_settings import XpbdSettings
from actors.robot.stances import Stance

Settings = Mapping[str, Any]


def make_engine(
    name: str, settings: Settings | None = None, stance: Stance | None = None
) -> ClothEngine:
    """The engine of a name, not yet reset.

    Args:
        name: a key of `ENGINES`.
        settings: the engine's own settings by name, where they differ from its defaults.
        stance: of the robot, for an engine in whose world it can stand; None: there is no robot.

    Raises:
        ValueError: there is no such engine, or it has no such setting, or a setting is out of
            its rule.
    """
    if name not in ENGINES:
        raise ValueError(
            f"engine: expected one of {', '.join(sorted(ENGINES))}; got {name!r}; name one of them"
        )
    return ENGINES[name](settings or {}, stance)


def with_material(
    name: str, settings: Settings | None, *, stiffness: float, friction: float
) -> Settings:
    """Settings of an engine for cloth that is stiffer and rougher by these factors.

    Args:
        name: a key of `ENGINES`.
        settings: as for `make_engine`.
        stiffness: what resistance to bending is multiplied with.
        friction: what friction with the table, and of layers, is multiplied with.
    """
    given = dict(settings or {})
    if name == "pybullet":
        usual = PyBulletSettings(**given)
        return given | {
            "bending_stiffness": usual.bending_stiffness * stiffness,
            "friction": usual.friction * friction,
        }
    cloth = XpbdSettings(**given)
    return given | {
        "bending_compliance": cloth.bending_compliance / stiffness,
        "table_friction": cloth.table_friction * friction,
        "layer_friction": cloth.layer_friction * friction,
    }


def _pybullet(settings: Settings, stance: Stance | None) -> ClothEngine:
    _check_names("pybullet", settings, PyBulletSettings.__dataclass_fields__)
    return PyBulletProcessEngine(PyBulletSettings(**settings), stance)


def _xpbd(settings: Settings, stance: Stance | None) -> ClothEngine:
    del stance  # it simulates cloth alone: a robot is the path of its fingers
    _check_names("xpbd", settings, XpbdSettings.__dataclass_fields__)
    return XpbdEngine(XpbdSettings(**settings))


def _check_names(engine: str, settings: Settings, known: Mapping[str, object]) -> None:
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise ValueError(
            f"engine settings of {engine}: expected some of {', '.join(known)}; got "
            f"{', '.join(unknown)}; leave out what this engine lacks"
        )


ENGINES: dict[str, Callable[[Settings, Stance | None], ClothEngine]] = {
    "pybullet": _pybullet,
    "xpbd": _xpbd,
}
"""Each engine's maker, from its settings and where a robot stands."""
