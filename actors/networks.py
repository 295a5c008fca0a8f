"""The action-preference network: pictures in, one number for each action out.

The convolutions are those of the source's reference [15] (8x8/4 with 32 channels, 4x4/2 with 64,
3x3/1 with 64), followed by 512 units; a dueling head has two streams of 512 units after the shared
convolutions. A policy belongs to whoever acts, so the network lives with the actors; the learner
improves it. Weights travel as safetensors, never as pickles.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from broker_config.errors import DecodeError, MessageError
from broker_config.specs import NetworkSpec

_CONVOLUTIONS = ((32, 8, 4), (64, 4, 2), (64, 3, 1))
"""Channels, kernel and stride of each layer, for height and width alike."""
_HIDDEN_UNITS = 512
_PENALTY_LINEAR_FROM = 10.0
"""beta * A above which the exponential of eq. 3.5 goes on as its tangent.

A = log(pi) / beta is never positive where the constraint of eq. 3.5 holds, so anything above 0 is
already a violation; at 10 the penalty is 22,026 / n_actions, and from 88 on float32 has no number
for the exponential.
"""


class PreferenceNetwork(nn.Module):
    """P(s, a; theta) for every action of a batch of pictures.

    Built by `build_network`; the parameters of one built by hand are whatever torch makes them.
    """

    def __init__(self, spec: NetworkSpec) -> None:
        super().__init__()
        self.spec = spec
        self.convolutions = nn.ModuleList()
        channels = spec.observation_shape[2]
        for outputs, kernel, stride in _CONVOLUTIONS:
            self.convolutions.append(nn.Conv2d(channels, outputs, kernel, stride))
            channels = outputs
        n_features = channels * math.prod(_feature_size(spec))
        self.is_dueling = spec.head != "plain"
        self.action_hidden = nn.Linear(n_features, _HIDDEN_UNITS)
        self.action_output = nn.Linear(_HIDDEN_UNITS, spec.n_actions)
        if self.is_dueling:
            self.value_hidden = nn.Linear(n_features, _HIDDEN_UNITS)
            self.value_output = nn.Linear(_HIDDEN_UNITS, 1)

    def forward(self, observations: Tensor) -> Tensor:
        """Preferences of a batch.

        Args:
            observations: u8[B, H, W, C], or the same already as f32 in 0...255.

        Returns:
            f32[B, A].
        """
        return self.from_feature_maps(self.feature_maps(observations))

    def feature_maps(self, observations: Tensor) -> Tensor:
        """What the last convolution makes of pictures, f32[B, 64, h, w], after its ReLU."""
        # A permuted [B, H, W, C] picture is torch's channels_last layout: no copy is made for it.
        maps = observations.permute(0, 3, 1, 2).to(torch.float32) * (1.0 / 255.0)
        for convolution in self.convolutions:
            maps = torch.relu(convolution(maps))
        return maps

    def from_feature_maps(self, maps: Tensor) -> Tensor:
        """Preferences f32[B, A] from what `feature_maps` gives."""
        features = maps.flatten(1)
        return self.head(*(torch.relu(layer(features)) for layer in self.hidden_layers))

    @property
    def hidden_layers(self) -> list[nn.Linear]:
        """What reads the features: the action stream and, if dueling, the value stream."""
        return [self.action_hidden, self.value_hidden] if self.is_dueling else [self.action_hidden]

    def head(self, action_units: Tensor, value_units: Tensor | None = None) -> Tensor:
        """Preferences from the hidden units of each stream.

        Args:
            action_units: f32[B, 512], after their ReLU.
            value_units: The same of a dueling network's value stream.

        Returns:
            f32[B, A].
        """
        outputs: Tensor = self.action_output(action_units)
        if value_units is None:
            return outputs
        return _join(self.spec, self.value_output(value_units), outputs)


def _join(spec: NetworkSpec, values: Tensor, outputs: Tensor) -> Tensor:
    """Joins the streams of a dueling head.

    Source: eq. 3.5 (`dueling-penalty`), eq. 3.4 (`dueling-exact`), reference [24] (`dueling-mean`).
    Differs: 1 / beta stands where eq. 3.5 prints 1 / eta, which is the same for sigma 0; otherwise
    the soft value of P would not be V. Beyond `_PENALTY_LINEAR_FROM` the penalty is linear.

    Args:
        spec: Gives the head and beta.
        values: V(s), f32[B, 1].
        outputs: The action stream, f32[B, A]: A(s, a) itself, or for `dueling-exact` the
            unnormalised preferences z of which A = log_softmax(beta * z) / beta.

    Returns:
        f32[B, A].
    """
    if spec.head == "dueling-mean":
        return values + outputs - outputs.mean(1, keepdim=True)
    scaled = spec.beta * outputs
    if spec.head == "dueling-exact":
        return values + torch.log_softmax(scaled, 1) / spec.beta
    violation = _bounded_exp(scaled).sum(1, keepdim=True) - 1.0
    return values + outputs - violation / spec.n_actions


def _bounded_exp(x: Tensor) -> Tensor:
    """exp(x) up to `_PENALTY_LINEAR_FROM`, its tangent from there on: finite, and never flat."""
    capped = x.clamp(max=_PENALTY_LINEAR_FROM)
    return capped.exp() * (1.0 + (x - capped))


def build_network(spec: NetworkSpec, seed: int, *, starts_at_zero_value: bool) -> PreferenceNetwork:
    """Builds a network whose weights are a function of its arguments only.

    Every weight and bias is drawn from a uniform distribution of half-width 1 / sqrt(inputs), as in
    reference [15]'s own code, in the order of `named_parameters`, from a generator of its own: the
    global random state is neither read nor changed.

    A preference network whose outputs start near 0 has the soft value log(n_actions) / beta
    everywhere: 3.2 at eta 1, but 322 at eta 0.01, which then takes 1 / (1 - gamma) target switches
    to decay. With `starts_at_zero_value` the output biases start at -log(n_actions) / beta, which
    is eq. 3.4 for the uniform policy and V = 0. Only the starting point differs: the network's
    form and the first policy are those without it. The source does not say how it starts.

    Args:
        spec: The network.
        seed: Any number that `torch.Generator.manual_seed` takes.
        starts_at_zero_value: True for DPN and EDPN; False for DQN, whose value is the largest
            output and starts near 0 by itself. `dueling-exact` and `dueling-mean` heads have their
            value from a stream of its own, and no use for it.

    Raises:
        MessageError: The picture is too small for the convolutions.
    """
    network = allocate_network(spec)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                _draw(module, generator)
        if starts_at_zero_value and spec.head in ("plain", "dueling-penalty"):
            network.action_output.bias.sub_(math.log(spec.n_actions) / spec.beta)
    return network


def allocate_network(spec: NetworkSpec) -> PreferenceNetwork:
    """A network on the CPU whose weights are still to be written, in the layout of the pictures.

    Raises:
        MessageError: The picture is too small for the convolutions.
    """
    with torch.device("meta"):
        network = PreferenceNetwork(spec)
    # Not `to_empty`: its way through meta tensors imports sympy, half a second of every start.
    for module in network.modules():
        for name, parameter in module.named_parameters(recurse=False):
            setattr(module, name, nn.Parameter(torch.empty(parameter.shape)))
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload] # not in its types
    return network


def _draw(layer: nn.Conv2d | nn.Linear, generator: torch.Generator) -> None:
    bound = 1.0 / math.sqrt(layer.weight[0].numel())
    layer.weight.uniform_(-bound, bound, generator=generator)
    if layer.bias is not None:
        layer.bias.uniform_(-bound, bound, generator=generator)


def _feature_size(spec: NetworkSpec) -> tuple[int, int]:
    """Height and width of the last convolution's output."""
    height, width, _ = spec.observation_shape
    for _, kernel, stride in _CONVOLUTIONS:
        height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
        if height < 1 or width < 1:
            raise MessageError(
                "observation_shape: expected a picture of at least 36x36 px, so that the "
                f"convolutions fit; got {list(spec.observation_shape)}; render it larger"
            )
    return height, width


def weights_to_bytes(weights: Mapping[str, Tensor]) -> bytes:
    """Serialises weights as safetensors; equal weights give equal bytes.

    Args:
        weights: What `PreferenceNetwork.state_dict` gives, on any device and in any layout.
    """
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in weights.items()}
    return safetensors.torch.save(plain)


def weights_from_bytes(data: bytes, spec: NetworkSpec) -> dict[str, Tensor]:
    """Reads what `weights_to_bytes` wrote for a network of this spec.

    Raises:
        DecodeError: The bytes are no safetensors, or not this network's weights: a tensor is
            missing, unexpected, or of another shape or dtype.
    """
    try:
        weights = safetensors.torch.load(data)
    except safetensors.SafetensorError as error:
        raise DecodeError(
            f"weights: expected safetensors; got {len(data)} bytes that are none ({error}); "
            "ask for the snapshot again"
        ) from error
    check_weights(weights, spec)
    return weights


def check_weights(weights: Mapping[str, Tensor], spec: NetworkSpec) -> None:
    """Refuses weights that are not exactly those of a network of this spec.

    Raises:
        DecodeError: A tensor is missing, unexpected, or of another shape or dtype.
    """
    with torch.device("meta"):
        expected = PreferenceNetwork(spec).state_dict()
    if missing := sorted(expected.keys() - weights.keys()):
        raise _mismatch(f"tensor {missing[0]}", "none", spec)
    if unexpected := sorted(weights.keys() - expected.keys()):
        raise _mismatch("only the network's own tensors", f"also {unexpected[0]}", spec)
    for name, tensor in expected.items():
        got = weights[name]
        if got.shape != tensor.shape or got.dtype != tensor.dtype:
            rule = f"{name} {_describe(tensor)}"
            raise _mismatch(rule, _describe(got), spec)


def _describe(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"


def _mismatch(rule: str, got: str, spec: NetworkSpec) -> DecodeError:
    return DecodeError(
        f"weights: expected {rule} for a {spec.head} network of {spec.n_actions} actions on "
        f"{list(spec.observation_shape)}; got {got}; actor and learner run different presets"
    )
