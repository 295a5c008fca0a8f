"""Where and by which path gradient steps are made."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Literal, get_args

from broker_config.errors import PresetError, StorageError

TrainingPath = Literal["reference", "winograd", "winograd-bf16", "graphs"]
"""`reference`: autograd, one operation at a time, float32: the definition of correct.
`winograd`: matrix products by hand, those of convolutions by Winograd's algorithm, float32.
`winograd-bf16`: the same, of factors that are rounded to bfloat16. `graphs`: autograd recorded as
CUDA graphs, float32."""

_PATHS: dict[str, tuple[TrainingPath, ...]] = {
    "cpu": ("winograd", "winograd-bf16", "reference"),
    "cuda": ("graphs", "reference"),
}
"""By type of device; the first is chosen where nothing else is asked for, but on a processor that
multiplies numbers of bfloat16 it is `winograd-bf16`."""


_REVISIONS: dict[TrainingPath, int] = {"winograd": 2, "winograd-bf16": 2}
"""How often a path's arithmetic has been another; raised with whatever changes its bits."""

EVALUATED_AT_ONCE = 64
"""Pictures of which paths that keep buffers compute preferences at a time."""


@dataclass(frozen=True)
class Compute:
    """What a trainer computes on.

    On a CPU results repeat bit for bit within a path, not from one path to another; on a GPU they
    are equal up to rounding.
    """

    device: str = "cpu"
    """cpu, cuda, cuda:1, ..."""
    path: TrainingPath | None = None
    """None chooses by the device."""

    def __post_init__(self) -> None:
        device_type = self.device.partition(":")[0]
        if device_type not in _PATHS:
            raise PresetError(f"device: expected cpu or cuda; got {self.device}; choose one")
        if self.path is not None and self.path not in _PATHS[device_type]:
            raise PresetError(
                f"training path: expected {' or '.join(_PATHS[device_type])} on {self.device}; got "
                f"{self.path}; choose one, or leave it out"
            )

    @property
    def chosen_path(self) -> TrainingPath:
        """The path, chosen if none is asked for: by what the device can do, never by a timing."""
        if self.path is not None:
            return self.path
        device_type = self.device.partition(":")[0]
        if device_type == "cpu" and multiplies_bfloat16():
            return "winograd-bf16"
        return _PATHS[device_type][0]

    def as_begun(self, begun: str) -> Compute:
        """The same, by the path by which something was begun.

        Args:
            begun: The text of the compute that began it.

        Raises:
            StorageError: Another path was asked for, or another device; or this version has no such
                path.
        """
        if begun.partition(" on ")[0] not in map(_steps_of, get_args(TrainingPath)):
            raise StorageError(
                f"expected to go on by {begun}, as it was begun; got a version of clothbus without "
                "it; go on with the version that began it, or begin anew"
            )
        paths = _PATHS[self.device.partition(":")[0]] if self.path is None else (self.path,)
        for path in paths:
            if str(same := replace(self, path=path)) == begun:
                return same
        raise StorageError(
            f"expected to go on by {begun}, as it was begun; got {self}; ask for the device and "
            "the --training-path that it was begun with"
        )

    def __str__(self) -> str:
        return f"{_steps_of(self.chosen_path)} on {self.device}"


def _steps_of(path: TrainingPath) -> str:
    revision = _REVISIONS.get(path, 1)
    return f"{path} steps" if revision == 1 else f"{path} steps of revision {revision}"


@cache
def multiplies_bfloat16() -> bool:
    """Whether this processor has instructions for products of bfloat16, by vectors or by tiles."""
    # Not torch, which knows as well: processes ask that do nothing else with it.
    import llvmlite.binding

    try:
        features = llvmlite.binding.get_host_cpu_features()
    except RuntimeError:  # LLVM knows nothing of this kind of processor
        return False
    return any(features.get(name, False) for name in ("avx512bf16", "amx-bf16"))


ON_CPU = Compute()
