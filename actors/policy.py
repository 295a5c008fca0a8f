"""Acting: from one observation to one action.

One observation at a time, and all arithmetic after the network in float64 with a numpy generator:
the same weights, observation and generator state give the same action in every process on one type
of CPU, as long as torch's thread count is the same (`torch.set_num_threads(1)` is the caller's).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from actors.grad_cam import grad_cam
from actors.networks import allocate_network, check_weights, weights_from_bytes
from broker_config.errors import MessageError
from broker_config.specs import NetworkSpec


class Policy:
    """The policies that one snapshot of a preference network defines.

    The weights are copied: training the network that they came from does not change the policy.
    Raises `DecodeError` where the weights are not those of the spec.
    """

    def __init__(self, spec: NetworkSpec, weights: Mapping[str, Tensor]) -> None:
        check_weights(weights, spec)
        network = allocate_network(spec)
        network.load_state_dict(dict(weights))
        self._network = network.requires_grad_(False).eval()
        self.spec = spec

    @classmethod
    def from_bytes(cls, spec: NetworkSpec, data: bytes) -> Policy:
        """The policy of a snapshot's safetensors bytes.

        Raises:
            DecodeError: The bytes are not weights of this spec.
        """
        return cls(spec, weights_from_bytes(data, spec))

    def preferences(self, observation: NDArray[np.uint8]) -> NDArray[np.float64]:
        """P(s, a) of every action.

        Args:
            observation: u8[H, W, C].

        Returns:
            f64[A].

        Raises:
            MessageError: The observation has another shape or dtype, or the network's output is
                not finite.
        """
        if observation.shape != self.spec.observation_shape or observation.dtype != np.uint8:
            raise MessageError(
                f"observation: expected uint8 {list(self.spec.observation_shape)}; got "
                f"{observation.dtype} {list(observation.shape)}; the task and the policy belong to "
                "different presets"
            )
        # torch accepts read-only memory only with a warning, and received pictures are read-only.
        batch = torch.tensor(observation[np.newaxis])
        with torch.inference_mode():
            outputs = self._network(batch)[0].numpy().astype(np.float64)
        if not np.isfinite(outputs).all():
            raise MessageError(
                f"preferences: expected finite numbers; got {outputs}; the learner diverged, lower "
                "eta or the learning rate"
            )
        return np.asarray(outputs)

    def probabilities(self, observation: NDArray[np.uint8]) -> NDArray[np.float64]:
        """The softmax policy pi(a given s), f64[A].

        Source: eqs. 2.10 and 4.8.
        """
        scaled = self.spec.beta * self.preferences(observation)
        unnormalised = np.exp(scaled - scaled.max())
        return np.asarray(unnormalised / unnormalised.sum())

    def attention(self, observation: NDArray[np.uint8], action: int) -> NDArray[np.float32]:
        """What of a picture speaks for an action, f32[H, W] in 0...1: see `grad_cam`."""
        return grad_cam(self._network, observation, action)

    def sample(self, observation: NDArray[np.uint8], generator: np.random.Generator) -> int:
        """Draws from the softmax policy; takes one number from the generator."""
        cumulative = np.cumsum(self.probabilities(observation))
        # The sum's last digits may fall short of 1: scaling keeps every draw inside the table.
        drawn = generator.random() * cumulative[-1]
        return int(np.searchsorted(cumulative, drawn, side="right").clip(max=len(cumulative) - 1))

    def greedy(self, observation: NDArray[np.uint8]) -> int:
        """The preferred action; the first of equals."""
        return int(np.argmax(self.preferences(observation)))

    def epsilon_greedy(
        self, observation: NDArray[np.uint8], epsilon: float, generator: np.random.Generator
    ) -> int:
        """A uniformly random action with probability epsilon, otherwise the preferred one.

        Takes two numbers from the generator whatever it does, so that the numbers of the following
        steps do not depend on this one's outcome.

        Raises:
            MessageError: epsilon is no probability.
        """
        if not 0.0 <= epsilon <= 1.0:
            raise MessageError(f"epsilon: expected a probability; got {epsilon}")
        explores = generator.random() < epsilon
        explored = int(generator.integers(self.spec.n_actions))
        return explored if explores else self.greedy(observation)
