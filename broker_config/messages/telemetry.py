"""What observers look at: best effort, with sequence numbers by which a gap shows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from broker_config.messages.presence import Role
from broker_config.messages.rules import require, require_array, require_count, require_id


@dataclass(frozen=True)
class Metrics:
    """Named numbers of one moment of a process."""

    role: Role
    id: str
    incarnation: str
    sequence: int
    """Counts the messages of this incarnation under this key."""
    step: int
    """The count against which the numbers are plotted: episodes absorbed, for the learner."""
    numbers: Mapping[str, float]

    def __post_init__(self) -> None:
        require_id("metrics.id", self.id)
        require_id("metrics.incarnation", self.incarnation)
        require_count("metrics.sequence", self.sequence)
        require_count("metrics.step", self.step)


@dataclass(frozen=True)
class Mark:
    """A place in a picture at which something was done."""

    kind: Literal["pick", "drop", "fold_line"]
    """The n-th `pick` of a view and its n-th `drop` are of one hand."""
    points_px: tuple[tuple[float, float], ...]
    """x and y from the picture's top left corner: two points of a line, else one."""

    def __post_init__(self) -> None:
        number = 2 if self.kind == "fold_line" else 1
        is_right = len(self.points_px) == number
        require(is_right, "mark.points_px", f"{number} for a {self.kind}", self.points_px)
        is_finite = all(math.isfinite(it) for point in self.points_px for it in point)
        require(is_finite, "mark.points_px", "finite numbers", self.points_px)


@dataclass(frozen=True)
class JointMotion:
    """How a robot's joints moved for an action: straight lines between K postures."""

    joints: tuple[str, ...]
    """The names of J joints, at least one."""
    secs_before: NDArray[np.float32]
    """f32[K], K of 1 or more, finite, not negative: how long before the view each posture was."""
    angles_rad: NDArray[np.float32]
    """f32[K, J], finite."""

    def __post_init__(self) -> None:
        k, j = len(self.secs_before), len(self.joints)
        require(min(k, j) > 0, "joint_motion", "a posture of a joint", f"{k} of {j}")
        require_array("joint_motion.secs_before", self.secs_before, "float32", (k,))
        require_array("joint_motion.angles_rad", self.angles_rad, "float32", (k, j))
        is_past = bool(np.isfinite(self.secs_before).all() and (self.secs_before >= 0).all())
        require(is_past, "joint_motion.secs_before", "0 or more", self.secs_before.tolist())
        is_finite = bool(np.isfinite(self.angles_rad).all())
        require(is_finite, "joint_motion.angles_rad", "finite numbers", "others")


@dataclass(frozen=True)
class View:
    """A small picture of what an actor sees, with what it has just done."""

    actor: str
    incarnation: str
    sequence: int
    """Counts the messages of this incarnation under this key."""
    ticket: int
    """Index of the ticket that is played."""
    attempt: int
    policy_version: int
    step: int
    """Steps of the episode so far; 0 shows the first state, before any action."""
    action: int | None
    """Index of the action that led here; None at step 0."""
    reward: float | None
    """What it earned."""
    picture: bytes
    """An encoded picture."""
    picture_format: Literal["png", "jpeg"]
    unix_secs: float
    """Wall clock of the actor's host; for people, never for ordering."""
    marks: tuple[Mark, ...] = ()
    """Where the action picked, dropped and folded, in pixels of this picture.

    The camera stands still within an episode: they are the same points in the picture before.
    """
    motion: JointMotion | None = None
    """How the robot moved for the action; None without a robot, or if it stood still."""

    def __post_init__(self) -> None:
        require_id("view.actor", self.actor)
        require_id("view.incarnation", self.incarnation)
        for name in ("sequence", "ticket", "attempt", "policy_version", "step"):
            require_count(f"view.{name}", getattr(self, name))
        has_both = self.action is not None and self.reward is not None
        has_none = self.action is None and self.reward is None
        rule = "action and reward together, and none at step 0"
        require(has_none if self.step == 0 else has_both, "view.action", rule, self.action)
        has_acted = bool(self.marks) or self.motion is not None
        rule = "no marks and no motion at step 0"
        require(self.step > 0 or not has_acted, "view.marks", rule, self.marks)
        require(math.isfinite(self.unix_secs), "view.unix_secs", "a finite time", self.unix_secs)
