"""The discriminators' network: a picture in, the logit of D out.

Small on purpose (section 4.1.3 asks for conservative updates): a discriminator that tells any two
pictures apart rewards nothing that the generator can follow.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from broker_config.errors import MessageError

_CONVOLUTIONS = ((8, 8, 4), (16, 4, 2), (16, 3, 1))
"""Channels, kernel and stride of each layer."""
_HIDDEN_UNITS = 64
_SLOPE = 0.2
"""Of the leaky ReLU below 0."""
_EVALUATED_AT_ONCE = 256


class DiscriminatorNetwork(nn.Module):
    """The logit of D(s), for a batch of pictures; D = sigmoid(logit)."""

    def __init__(self, observation_shape: tuple[int, int, int], spectral_norm: bool) -> None:
        super().__init__()
        height, width, channels = observation_shape
        layers: list[nn.Module] = []
        for outputs, kernel, stride in _CONVOLUTIONS:
            layers.append(nn.Conv2d(channels, outputs, kernel, stride))
            channels = outputs
            height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
        if min(height, width) < 1:
            raise MessageError(
                "observation_shape: expected a picture of at least 36x36 px, so that the "
                f"convolutions fit; got {list(observation_shape)}; render it larger"
            )
        layers += [nn.Linear(channels * height * width, _HIDDEN_UNITS), nn.Linear(_HIDDEN_UNITS, 1)]
        if spectral_norm:
            layers = [nn.utils.parametrizations.spectral_norm(layer) for layer in layers]
        self.convolutions = nn.ModuleList(layers[: len(_CONVOLUTIONS)])
        self.hidden, self.output = layers[len(_CONVOLUTIONS) :]

    def forward(self, pictures: Tensor) -> Tensor:
        """Logits of a batch.

        Args:
            pictures: f32[B, C, H, W] in 0...1.

        Returns:
            f32[B].
        """
        features = pictures
        for convolution in self.convolutions:
            features = leaky_relu(convolution(features), _SLOPE)
        logits: Tensor = self.output(leaky_relu(self.hidden(features.flatten(1)), _SLOPE))
        return logits.squeeze(1)


def build_discriminator(
    observation_shape: tuple[int, int, int], seed: int, *, spectral_norm: bool
) -> DiscriminatorNetwork:
    """A network whose weights are a function of the arguments only.

    The global random state is neither read nor changed.

    Raises:
        MessageError: The picture is too small for the convolutions.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)  # for spectral norm's first vectors, too
        return DiscriminatorNetwork(observation_shape, spectral_norm)


def as_input(pictures: Tensor) -> Tensor:
    """Pictures u8[B, H, W, C] as f32[B, C, H, W] in 0...1."""
    return pictures.permute(0, 3, 1, 2).to(torch.float32) / 255.0


@torch.no_grad()
def logits_of(network: DiscriminatorNetwork, states: Tensor) -> Tensor:
    """Logits of states as they are, f32[n]; the network stays as it is.

    Args:
        network: In training mode, and again so afterwards.
        states: u8[n, H, W, C].
    """
    network.eval()  # spectral norm takes no step of its own
    parts = [network(as_input(part)) for part in torch.split(states, _EVALUATED_AT_ONCE)]
    network.train()
    return torch.cat(parts)
