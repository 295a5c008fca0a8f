"""The robot's joints and a body of simple shapes, as a URDF that PyBullet loads.

Frames, limits and axes are those of the NEXTAGE OPEN (facts from its published description, BSD
part of rtmros_nextage). Links are boxes and rods with round ends of about the robot's dimensions:
**assumed**, as is the gripper, which points down when the forearm is level.

Robot frame: origin at the waist, x forward, y left, z up, metres.
"""

from dataclasses import dataclass
from math import pi
from typing import Final, Literal, get_args

Arm = Literal["left", "right"]
ARMS: Final[tuple[Arm, ...]] = get_args(Arm)
ARM_JOINTS: Final = 6

GRIPPER_LENGTH_M: Final = 0.14
"""From the last joint's axis to the fingers' tips."""

SPEED_RAD_PER_S: Final = 0.5
"""Of every joint; the robot's own description says so."""


@dataclass(frozen=True)
class Box:
    """A box along the axes of its link's frame."""

    size_m: tuple[float, float, float]
    centre_m: tuple[float, float, float]

    def urdf(self, purpose: str) -> str:
        """As a "visual" or a "collision"."""
        return _shape(
            purpose, f'<box size="{_words(self.size_m)}"/>', self.centre_m, (0.0, 0.0, 0.0)
        )


@dataclass(frozen=True)
class Rod:
    """A cylinder with round ends along an axis of its link's frame: a capsule."""

    radius_m: float
    length_m: float
    """From end to end."""

    centre_m: tuple[float, float, float]
    along: int = 2
    """The axis: 0, 1 or 2."""

    @property
    def core_m(self) -> float:
        """The length without its round ends."""
        return self.length_m - 2 * self.radius_m

    def urdf(self, purpose: str) -> str:
        """As a "visual" or a "collision"."""
        geometry = f'<capsule radius="{self.radius_m:g}" length="{self.core_m:g}"/>'
        turns = ((0.0, pi / 2, 0.0), (pi / 2, 0.0, 0.0), (0.0, 0.0, 0.0))
        return _shape(purpose, geometry, self.centre_m, turns[self.along])


@dataclass(frozen=True)
class Joint:
    """A revolute joint and the link that it moves."""

    name: str
    parent: str
    """The link that it is fixed to."""

    origin_m: tuple[float, float, float]
    """Of its frame in the parent's."""

    roll_rad: float
    """Of its frame in the parent's, around x."""

    axis: tuple[int, int, int]
    lower_rad: float
    upper_rad: float
    body: Box | Rod
    """Of the moved link."""

    @property
    def link(self) -> str:
        """The link that it moves."""
        return self.name.replace("JOINT", "LINK")


def _shape(purpose: str, geometry: str, centre: tuple[float, ...], rpy: tuple[float, ...]) -> str:
    origin = f'<origin xyz="{_words(centre)}" rpy="{_words(rpy)}"/>'
    return f"<{purpose}>{origin}<geometry>{geometry}</geometry></{purpose}>"


def _words(numbers: tuple[float, ...]) -> str:
    return " ".join(f"{number:g}" for number in numbers)


def _arm(arm: Arm) -> list[Joint]:
    side, letter = (1.0, "L") if arm == "left" else (-1.0, "R")

    def name(index: int) -> str:
        return f"{letter}ARM_JOINT{index}"

    def link(index: int) -> str:
        return f"{letter}ARM_LINK{index}"

    wrist = (-1.8326, 2.87979) if arm == "left" else (-2.87979, 1.8326)
    gripper = Rod(0.016, GRIPPER_LENGTH_M, (-GRIPPER_LENGTH_M / 2, 0.0, 0.0), along=0)
    return [
        Joint(
            name(0), "CHEST_LINK0", (0.0, side * 0.145, 0.370296), -side * 0.2618, (0, 0, 1),
            -1.53589, 1.53589, Rod(0.05, 0.11, (0.0, 0.0, 0.0)),
        ),
        Joint(
            name(1), link(0), (0.0, 0.0, 0.0), 0.0, (0, 1, 0), -2.44346, 1.0472,
            Rod(0.035, 0.2, (0.0, side * 0.07, -0.12)),
        ),
        Joint(
            name(2), link(1), (0.0, side * 0.095, -0.25), 0.0, (0, 1, 0), -2.75762, 0.0,
            Rod(0.04, 0.09, (-0.015, -side * 0.02, 0.0), along=1),
        ),
        Joint(
            name(3), link(2), (-0.03, 0.0, 0.0), 0.0, (0, 0, 1), *wrist,
            Rod(0.035, 0.2, (0.0, 0.0, -0.115)),
        ),
        Joint(
            name(4), link(3), (0.0, 0.0, -0.235), 0.0, (0, 1, 0), -1.74533, 1.74533,
            Rod(0.03, 0.08, (-0.02, 0.0, -0.045)),
        ),
        Joint(
            name(5), link(4), (-0.047, 0.0, -0.09), 0.0, (1, 0, 0), -2.84489, 2.84489, gripper,
        ),
    ]  # fmt: skip


JOINTS: Final[tuple[Joint, ...]] = (
    Joint(
        "CHEST_JOINT0", "WAIST", (0.0, 0.0, 0.0), 0.0, (0, 0, 1), -2.84489, 2.84489,
        Box((0.14, 0.12, 0.36), (-0.03, 0.0, 0.2)),
    ),
    Joint(
        "HEAD_JOINT0", "CHEST_LINK0", (0.0, 0.0, 0.5695), 0.0, (0, 0, 1), -1.22173, 1.22173,
        Rod(0.03, 0.12, (0.0, 0.0, -0.08)),
    ),
    Joint(
        "HEAD_JOINT1", "HEAD_LINK0", (0.0, 0.0, 0.0), 0.0, (0, 1, 0), -0.349, 1.22173,
        Box((0.14, 0.16, 0.12), (0.02, 0.0, 0.06)),
    ),
    *_arm("right"),
    *_arm("left"),
)  # fmt: skip
"""All 15, parents before children."""

JOINT_NAMES: Final = tuple(joint.name for joint in JOINTS)
CHEST_JOINT: Final = JOINT_NAMES.index("CHEST_JOINT0")


def _both_arms(left_rad: tuple[float, ...]) -> tuple[float, ...]:
    """All joints in the order of `JOINTS` for a left arm's six, the right arm mirrored."""
    mirrored = (-1, 1, 1, -1, 1, -1)
    right_rad = [sign * angle for sign, angle in zip(mirrored, left_rad, strict=True)]
    return (0.0, 0.0, 0.0, *right_rad, *left_rad)


_LEFT_INITIAL_DEG = (0.6, 0.0, -100.0, -15.2, 9.4, -3.2)
INITIAL_POSE_RAD: Final = _both_arms(tuple(degrees * pi / 180 for degrees in _LEFT_INITIAL_DEG))
"""The robot's own: both forearms level over the table, the hands down. Angles are looked for from
here; with the gripper of this model its fingers are at the table's height."""

WITHDRAWN_POSE_RAD: Final = _both_arms((0.75, -0.05, -2.55, -0.75, 0.55, 0.0))
"""Where arms rest: beside the body, out of the picture. **assumed**"""

FINGERS: Final[dict[Arm, str]] = {"left": "L_FINGERS", "right": "R_FINGERS"}
"""Links without a body at the fingers' tips."""


def arm_joints(arm: Arm) -> list[int]:
    """Where in `JOINTS` an arm's six are."""
    letter = "L" if arm == "left" else "R"
    return [i for i, name in enumerate(JOINT_NAMES) if name.startswith(f"{letter}ARM")]


def urdf(*, solid: bool = True) -> str:
    """The robot as a URDF document. Links have no mass, so that they stay as they are posed.

    Args:
        solid: whether bodies can touch each other and what else there is.
    """
    inertia = (
        '<inertial><mass value="0"/>'
        '<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    purposes = ("visual", "collision") if solid else ("visual",)
    parts = [f'<link name="WAIST">{inertia}</link>']
    for joint in JOINTS:
        bodies = "\n".join(joint.body.urdf(purpose) for purpose in purposes)
        # PyBullet reads long lines in pieces.
        parts.append(f'<link name="{joint.link}">\n{inertia}\n{bodies}\n</link>')
        parts.append(
            f'<joint name="{joint.name}" type="revolute">'
            f'<parent link="{joint.parent}"/><child link="{joint.link}"/>'
            f'<origin xyz="{_words(joint.origin_m)}" rpy="{joint.roll_rad:g} 0 0"/>'
            f'<axis xyz="{_words(joint.axis)}"/>'
            f'<limit lower="{joint.lower_rad:g}" upper="{joint.upper_rad:g}" effort="100" '
            f'velocity="{SPEED_RAD_PER_S:g}"/></joint>'
        )
    for arm, fingers in FINGERS.items():
        last = JOINTS[arm_joints(arm)[-1]].link
        parts.append(f'<link name="{fingers}">{inertia}</link>')
        parts.append(
            f'<joint name="{fingers}_JOINT" type="fixed"><parent link="{last}"/>'
            f'<child link="{fingers}"/><origin xyz="{-GRIPPER_LENGTH_M:g} 0 0"/></joint>'
        )
    lines = ['<?xml version="1.0"?>', '<robot name="nextage-like">', *parts, "</robot>"]
    return "\n".join(lines)
