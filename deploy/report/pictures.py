"""Film strips and Grad-CAM as pictures that lie in the page itself."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from actors.policy import Policy
from broker_config.messages import Trajectory
from deploy.attention import with_heat
from deploy.report.episodes import ShownEpisode

_MOST_PICTURES: Final = 31
_MOST_ATTENDED: Final = 10
_MOST_SIDE_PX: Final = 84


@dataclass(frozen=True)
class Picture:
    """A picture of the page."""

    data_uri: str
    caption: str
    detail: str
    """A second line of the caption; may be empty."""
    alt: str


@dataclass(frozen=True)
class Strip:
    """Pictures in a row."""

    title: str
    pictures: Sequence[Picture]
    n_steps: int
    """Of the episode; there may be fewer pictures."""


@dataclass(frozen=True)
class AttendedPicture:
    """A picture, and what of it speaks for the action that the policy prefers there."""

    seen: Picture
    attended: Picture


def film_strip(title: str, episode: ShownEpisode) -> Strip:
    """An episode's pictures with the action before each and its reward, evenly picked if many."""
    taken = [
        (part, number)
        for place, part in enumerate(episode.parts)
        for number in range(min(place, 1), part.steps + 1)  # each part begins where one ended
    ]
    picked = np.unique(np.linspace(0, len(taken) - 1, _MOST_PICTURES).round().astype(int))
    pictures = []
    for place in picked:
        part, number = taken[place]
        uri = _data_uri(part.observations[number])
        if place == 0:
            pictures.append(Picture(uri, "start", "", "the start"))
            continue
        action, reward = part.actions[number - 1], f"{part.rewards[number - 1]:.2f}"
        alt = f"after step {place}: action {action}, reward {reward}"
        pictures.append(Picture(uri, f"{place}: action {action}", reward, alt))
    return Strip(title, pictures, len(taken) - 1)


def attended_pictures(policy: Policy, trajectory: Trajectory) -> list[AttendedPicture]:
    """Grad-CAM of what a policy prefers on pictures of an episode, evenly picked."""
    places = np.linspace(0, trajectory.steps - 1, _MOST_ATTENDED).round().astype(int)
    found = []
    for place in np.unique(places):
        picture = trajectory.observations[place]
        action = policy.greedy(picture)
        mixed = with_heat(picture, policy.attention(picture, action))
        step = f"step {place + 1}"
        found.append(
            AttendedPicture(
                Picture(_data_uri(picture), step, "", f"before {step}"),
                Picture(
                    _data_uri(mixed),
                    f"action {action}",
                    "",
                    f"before {step}: what speaks for action {action}, as heat",
                ),
            )
        )
    return found


def _data_uri(picture: NDArray[np.uint8]) -> str:
    """A picture, u8[H, W, C], as PNG in a URI."""
    height, width, channels = picture.shape
    scale = _MOST_SIDE_PX / max(height, width)
    if scale < 1:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        picture = picture.reshape(*picture.shape[:2], channels)
    ordered = picture[..., ::-1] if channels == 3 else picture
    is_written, data = cv2.imencode(".png", np.ascontiguousarray(ordered))
    assert is_written  # a picture of 8 bits
    return f"data:image/png;base64,{base64.b64encode(data.tobytes()).decode()}"
