"""Grad-CAM: which parts of a picture speak for an action.

Source: figures 3.12 and 4.13, after its reference [45].
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from actors.networks import PreferenceNetwork


def grad_cam(
    network: PreferenceNetwork, observation: NDArray[np.uint8], action: int
) -> NDArray[np.float32]:
    """Where the last convolution's maps raise P(s, a).

    A map's weight is the mean of dP(s, a)/dA over its places; the weighted sum of the maps A is cut
    off at 0, enlarged to the picture's size and scaled to at most 1.

    Args:
        network: Gives P.
        observation: u8[H, W, C].
        action: Whose preference is asked about.

    Returns:
        f32[H, W] in 0...1; all 0 where nothing speaks for the action.
    """
    with torch.enable_grad():
        maps = network.feature_maps(torch.tensor(observation[np.newaxis])).detach()
        maps.requires_grad_()
        preference = network.from_feature_maps(maps)[0, action]
        (gradients,) = torch.autograd.grad(preference, maps)
    weights = gradients.mean((2, 3), keepdim=True)
    heat = torch.relu((weights * maps.detach()).sum(1))[0]
    height, width, _ = observation.shape
    enlarged = np.asarray(cv2.resize(heat.numpy(), (width, height), interpolation=cv2.INTER_LINEAR))
    highest = float(enlarged.max())
    return np.asarray(enlarged / highest if highest > 0 else enlarged, np.float32)
