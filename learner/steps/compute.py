"""Where and by which path gradient steps are made."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from broker_config.errors import PresetError, StorageError

TrainingPath = Literal["reference", "winograd", "products-bf16", "graphs"]
"""`reference`: autograd, one operation at a time, float32: the definition of correct.
`winograd`: products by hand, those of convolutions by Winograd's algorithm, float32.
`products-bf16`: products by hand, rounded to bfloat16. `graphs`: autograd recorded as CUDA graphs,
float32."""

_PATHS: dict[str, tuple[TrainingPath, ...]] = {
    "cpu": ("winograd", "reference", "products-bf16"),
    "cuda": ("graphs", "reference"),
}
"""By type of device; the first is chosen where nothing else is asked for."""


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
        """The path, chosen if none is asked for."""
        return self.path or _PATHS[self.device.partition(":")[0]][0]

    def as_begun(self, begun: str) -> Compute:
        """The same, by the path by which something was begun.

        Args:
            begun: The text of the compute that began it.

        Raises:
            StorageError: Another path was asked for, or another device.
        """
        paths = _PATHS[self.device.partition(":")[0]] if self.path is None else (self.path,)
        for path in paths:
            if str(same := replace(self, path=path)) == begun:
                return same
        raise StorageError(
            f"expected to go on by {begun}, as it was begun; got {self}; ask for the device and "
            "the --training-path that it was begun with"
        )

    def __str__(self) -> str:
        return f"{self.chosen_path} steps on {self.device}"


ON_CPU = Compute()
