"""What actor and learner must agree on about a network: its inputs, outputs and head."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from broker_config.errors import MessageError

Head = Literal["plain", "dueling-penalty", "dueling-exact", "dueling-mean"]
"""How the last layer makes one number for each action.

* `plain`: one linear layer (DPN, DQN).
* `dueling-penalty`: value and advantage streams joined by eq. 3.5, the source's literal form.
* `dueling-exact`: value plus log-softmax of the other stream divided by beta, so that the soft
  value of P is exactly V (eq. 3.4).
* `dueling-mean`: value plus advantage minus its mean (Dueling DQN, the source's reference 24).
"""


@dataclass(frozen=True)
class NetworkSpec:
    """A network as actor and learner must both build it."""

    observation_shape: tuple[int, int, int]
    """Height, width and channels of a uint8 picture."""
    n_actions: int
    head: Head
    beta: float
    """eta / (1 + sigma * eta): enters the dueling heads and the softmax policy (eq. 4.8)."""

    def __post_init__(self) -> None:
        height, width, channels = self.observation_shape
        if min(height, width) < 1 or channels not in (1, 3):
            raise MessageError(
                f"observation_shape: expected [height, width, 1 or 3]; "
                f"got {list(self.observation_shape)}; pictures are grayscale or RGB"
            )
        if self.n_actions < 2:
            raise MessageError(f"n_actions: expected at least 2; got {self.n_actions}")
        if not (math.isfinite(self.beta) and self.beta > 0):
            raise MessageError(f"beta: expected a finite positive number; got {self.beta}")
