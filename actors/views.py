"""What an actor shows of its episodes to whoever looks: small pictures, best effort."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from actors.rollout import Observation, Step
from broker_config.bus import Bus
from broker_config.errors import ClothbusError
from broker_config.messages import JointMotion, Ticket, Trajectory, View

if TYPE_CHECKING:
    from actors.robot.motion import JointPath  # brings numba, which only robots need

_log = logging.getLogger(__name__)

PICTURES_PER_SEC = 10.0


class Views:
    """Publishes the first and the last picture of each episode, and some of those between.

    Only what is published is encoded: an 84 x 84 picture costs the acting thread a fraction of a
    millisecond, at most ten times a second.
    """

    def __init__(
        self, bus: Bus, actor: str, incarnation: str, pictures_per_sec: float = PICTURES_PER_SEC
    ) -> None:
        """Prepares it.

        Args:
            bus: The actor's.
            actor: Its name.
            incarnation: Of its process.
            pictures_per_sec: No more than so many, first and last pictures apart.
        """
        self._publisher = bus.publisher(bus.keys.view(actor))
        self._actor = actor
        self._incarnation = incarnation
        self._pause_secs = 1.0 / pictures_per_sec
        self._next_secs = 0.0
        self._told_secs = 0.0
        self._sequence = 0
        self._has_failed = False

    def show_start(self, ticket: Ticket, observation: Observation) -> None:
        """Publishes the picture with which an episode begins: u8[H, W, 1 or 3], RGB."""
        self._publish(ticket, 0, observation, None, None)
        self._told_secs = time.monotonic()

    def show_step(self, ticket: Ticket, number: int, step: Step, *, is_last: bool) -> None:
        """Publishes the picture after a step, if it is time for one.

        Args:
            ticket: Of the episode.
            number: Steps so far, this one included.
            step: The step.
            is_last: The episode ends with it: it is published in any case.
        """
        now_secs = time.monotonic()
        if is_last or now_secs >= self._next_secs:
            took_secs = now_secs - self._told_secs
            motion = None if step.motion is None else _joint_motion(step.motion, took_secs)
            self._publish(ticket, number, step.observation, step, motion)
        self._told_secs = time.monotonic()

    def _publish(
        self,
        ticket: Ticket,
        number: int,
        observation: Observation,
        step: Step | None,
        motion: JointMotion | None,
    ) -> None:
        self._next_secs = time.monotonic() + self._pause_secs
        view = View(
            actor=self._actor,
            incarnation=self._incarnation,
            sequence=self._sequence,
            ticket=ticket.index,
            attempt=ticket.attempt,
            policy_version=ticket.policy_version,
            step=number,
            action=step.action if step else None,
            reward=step.reward if step else None,
            picture=_png(observation),
            picture_format="png",
            unix_secs=time.time(),
            marks=step.marks if step else (),
            motion=motion,
        )
        self._sequence += 1
        try:
            self._publisher.put(view)
        except ClothbusError as error:  # nobody acts worse for not being looked at
            if not self._has_failed:
                _log.warning("Views are not shown: %s", error)
            self._has_failed = True


def _joint_motion(path: JointPath, took_secs: float) -> JointMotion:
    """A path that ends now; a simulated robot's is squeezed into the time that its step took."""
    lasted_secs = float(path.times_secs[-1])
    pace = min(1.0, took_secs / lasted_secs)
    secs_before = (lasted_secs - path.times_secs) * pace
    return JointMotion(
        path.names, secs_before.astype(np.float32), path.joints_rad.astype(np.float32)
    )


def views_of(
    trajectory: Trajectory, seen_unix_secs: Sequence[float], incarnation: str, first_sequence: int
) -> Iterator[View]:
    """All that an actor saw in an episode, for a recording.

    Args:
        trajectory: The episode.
        seen_unix_secs: When each of its T + 1 observations was made, by the wall clock.
        incarnation: Of the actor's process.
        first_sequence: Number of the first view; those of an incarnation count on.
    """
    ticket = trajectory.ticket
    for step, (observation, unix_secs) in enumerate(
        zip(trajectory.observations, seen_unix_secs, strict=True)
    ):
        yield View(
            actor=trajectory.id.actor,
            incarnation=incarnation,
            sequence=first_sequence + step,
            ticket=ticket.index,
            attempt=ticket.attempt,
            policy_version=ticket.policy_version,
            step=step,
            action=int(trajectory.actions[step - 1]) if step else None,
            reward=float(trajectory.rewards[step - 1]) if step else None,
            picture=_png(observation),
            picture_format="png",
            unix_secs=unix_secs,
        )


def _png(observation: Observation) -> bytes:
    is_rgb = observation.shape[-1] == 3
    pixels = cv2.cvtColor(observation, cv2.COLOR_RGB2BGR) if is_rgb else observation
    was_encoded, data = cv2.imencode(".png", np.ascontiguousarray(pixels))
    assert was_encoded, f"no PNG of {observation.dtype} {observation.shape}"
    return data.tobytes()
