"""What a recording holds for viewers that are not ours: pictures, marks in them, numbers, joints.

Pictures and marks are Foxglove's protobuf messages. Numbers and joints are ROS 2 messages: Foxglove
and Lichtblick plot these as they would JSON or protobuf, but of the three only ROS 2's become plots
in Rerun, which shows JSON as bytes and a protobuf number as a field that a person must map first.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from foxglove.messages import (
    CircleAnnotation,
    Color,
    CompressedImage,
    ImageAnnotations,
    Point2,
    PointsAnnotation,
    PointsAnnotationType,
    TextAnnotation,
    Timestamp,
)

from broker_config.messages import JointMotion, Mark, Metrics, View
from broker_config.recording.format import (
    ANNOTATIONS_SUFFIX,
    IMAGE_SUFFIX,
    REWARD_SUFFIX,
    joints_topic,
    metrics_topic,
    view_topic,
)

_NS_PER_SEC = 1_000_000_000
_MOST_FOXGLOVE_SECS = 2**32 - 1
_MOST_ROS_SECS = 2**31 - 1
"""A clock that is wrong by decades must not stop a recorder."""

_HAND_PX = 5.0
_LINE_PX = 1.0
_TEXT_PX = 4.0
_PICK = Color(r=0.0, g=1.0, b=1.0, a=1.0)
_DROP = Color(r=1.0, g=0.0, b=1.0, a=1.0)
_WAY = Color(r=1.0, g=1.0, b=1.0, a=1.0)
_FOLD_LINE = Color(r=1.0, g=1.0, b=0.0, a=1.0)
_TEXT = Color(r=1.0, g=1.0, b=1.0, a=1.0)
_TEXT_GROUND = Color(r=0.0, g=0.0, b=0.0, a=0.5)


@dataclass(frozen=True)
class Form:
    """How the messages of a channel are to be read."""

    encoding: str
    """Of the messages: `protobuf`, or `cdr`, which ROS 2 uses."""
    schema_name: str
    schema_encoding: str
    schema: bytes


@dataclass(frozen=True)
class Shown:
    """A message for viewers."""

    topic: str
    form: Form
    payload: bytes
    secs_before: float = 0.0
    """How long before the message that it is of."""


def shown_of_view(view: View, unix_ns: int) -> Iterator[Shown]:
    """A view's picture, what is drawn over it, its reward, and how the robot moved.

    Args:
        view: What an actor saw.
        unix_ns: When, as MCAP holds it.
    """
    topic = view_topic(view.actor)
    stamp = Timestamp(*_stamp(unix_ns, _MOST_FOXGLOVE_SECS))
    yield Shown(topic + IMAGE_SUFFIX, _IMAGE, _image(view, stamp))
    # Also with nothing to mark: viewers leave standing what was drawn last.
    yield Shown(topic + ANNOTATIONS_SUFFIX, _ANNOTATIONS, _annotations(view, stamp))
    if view.reward is not None:
        yield Shown(topic + REWARD_SUFFIX, _NUMBER, _number(view.reward))
    if view.motion is not None:
        yield from _joint_states(joints_topic(view.actor), view.motion, unix_ns)


def shown_of_metrics(metrics: Metrics) -> Iterator[Shown]:
    """Each of the numbers as a series of its own, since later messages may have others."""
    topic = metrics_topic(metrics.role, metrics.id)
    for name, number in metrics.numbers.items():
        yield Shown(f"{topic}/{name}", _NUMBER, _number(number))


def _stamp(unix_ns: int, most_secs: int) -> tuple[int, int]:
    secs, ns = divmod(max(0, unix_ns), _NS_PER_SEC)
    return min(secs, most_secs), ns


# Pictures and marks: protobuf ---------------------------------------------------------------------


def _foxglove_form(message: type[CompressedImage | ImageAnnotations]) -> Form:
    schema = message.get_schema()
    return Form("protobuf", schema.name, schema.encoding, schema.data)


_IMAGE: Final = _foxglove_form(CompressedImage)
_ANNOTATIONS: Final = _foxglove_form(ImageAnnotations)


def _image(view: View, stamp: Timestamp) -> bytes:
    return CompressedImage(
        timestamp=stamp, frame_id=view.actor, data=view.picture, format=view.picture_format
    ).encode()


def _annotations(view: View, stamp: Timestamp) -> bytes:
    """Stamped as a whole and one by one: older viewers know the latter only."""
    picks = [mark for mark in view.marks if mark.kind == "pick"]
    drops = [mark for mark in view.marks if mark.kind == "drop"]
    folds = [mark for mark in view.marks if mark.kind == "fold_line"]
    ways = [
        _line(stamp, (*pick.points_px, *drop.points_px), _WAY)
        for pick, drop in zip(picks, drops, strict=False)
    ]
    return ImageAnnotations(
        timestamp=stamp,
        circles=[
            *(_circle(stamp, mark, _PICK) for mark in picks),
            *(_circle(stamp, mark, _DROP) for mark in drops),
        ],
        points=[*ways, *(_line(stamp, mark.points_px, _FOLD_LINE) for mark in folds)],
        texts=[
            TextAnnotation(
                timestamp=stamp,
                position=Point2(x=1.0, y=1.0 + _TEXT_PX),
                text=_described(view),
                font_size=_TEXT_PX,
                text_color=_TEXT,
                background_color=_TEXT_GROUND,
            )
        ],
    ).encode()


def _circle(stamp: Timestamp, mark: Mark, colour: Color) -> CircleAnnotation:
    ((x, y),) = mark.points_px
    return CircleAnnotation(
        timestamp=stamp,
        position=Point2(x=x, y=y),
        diameter=_HAND_PX,
        thickness=_LINE_PX,
        outline_color=colour,
    )


def _line(
    stamp: Timestamp, points_px: tuple[tuple[float, float], ...], colour: Color
) -> PointsAnnotation:
    return PointsAnnotation(
        timestamp=stamp,
        type=PointsAnnotationType.LineStrip,
        points=[Point2(x=x, y=y) for x, y in points_px],
        outline_color=colour,
        thickness=_LINE_PX,
    )


def _described(view: View) -> str:
    if view.reward is None:
        return f"step {view.step}"
    return f"step {view.step}: action {view.action}, reward {view.reward:.3g}"


# Numbers and joints: ROS 2 ------------------------------------------------------------------------


def _ros_form(name: str, *definitions: str) -> Form:
    """Of the message's definition and of those, each with its name, that it is made of."""
    separator = "\n" + "=" * 80 + "\n"
    return Form("cdr", name, "ros2msg", separator.join(definitions).encode())


_NUMBER: Final = _ros_form(
    "std_msgs/msg/Float64MultiArray",
    "std_msgs/MultiArrayLayout layout\nfloat64[] data",
    "MSG: std_msgs/MultiArrayLayout\nstd_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
    "MSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride",
)
"""An array of one: of ROS 2's messages with a number and no other meaning, all viewers plot it."""

_JOINT_STATE: Final = _ros_form(
    "sensor_msgs/msg/JointState",
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
    "float64[] effort",
    "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id",
    "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec",
)

_CDR_HEAD: Final = b"\x00\x01\x00\x00"
"""Little endian; alignment counts from behind it."""

_ARRAY_OF_ONE: Final = struct.Struct("<4sIII4xd")
"""Head; no dimensions, no offset, one number; eight bytes are aligned to eight."""


def _number(value: float) -> bytes:
    return _ARRAY_OF_ONE.pack(_CDR_HEAD, 0, 0, 1, value)


def _joint_states(topic: str, motion: JointMotion, unix_ns: int) -> Iterator[Shown]:
    before_stamp, after_stamp = _CDR_HEAD, _named_joints(motion.joints)
    no_velocity_no_effort = struct.pack("<II", 0, 0)
    angles = motion.angles_rad.astype("<f8")
    for secs_before, row in zip(motion.secs_before.tolist(), angles, strict=True):
        posture_ns = unix_ns - round(secs_before * _NS_PER_SEC)
        stamp = struct.pack("<iI", *_stamp(posture_ns, _MOST_ROS_SECS))
        payload = before_stamp + stamp + after_stamp + row.tobytes() + no_velocity_no_effort
        yield Shown(topic, _JOINT_STATE, payload, secs_before)


def _named_joints(names: tuple[str, ...]) -> bytes:
    """A joint state between its stamp and its positions."""
    stamp_bytes = 8
    parts = bytearray(stamp_bytes)
    for text in ("", None, *names):
        parts += bytes(-len(parts) % 4)
        if text is None:
            parts += struct.pack("<I", len(names))
        else:
            encoded = text.encode() + b"\x00"
            parts += struct.pack("<I", len(encoded)) + encoded
    parts += bytes(-len(parts) % 4)
    parts += struct.pack("<I", len(names))
    parts += bytes(-len(parts) % 8)
    return bytes(parts[stamp_bytes:])
