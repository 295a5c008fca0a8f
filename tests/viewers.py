"""Reads recordings as programs do that are not ours: the mcap library and each message's schema."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader


@dataclass(frozen=True)
class Seen:
    """A message that a viewer can read."""

    topic: str
    schema: str
    log_time_ns: int
    publish_time_ns: int
    value: Any
    """A protobuf message, or for ROS 2's its fields by name."""


def seen(path: Path) -> Iterator[Seen]:
    """What viewers understand of a finished segment, in the order of log times."""
    with path.open("rb") as file:
        for schema, channel, item in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            match channel.message_encoding, schema.encoding:
                case "protobuf", "protobuf":
                    value: Any = protobuf_class(schema.name, schema.data).FromString(item.data)
                case "cdr", "ros2msg":
                    value = _ROS[schema.name](Cdr(item.data))
                case encodings:
                    assert encodings == ("msgpack", ""), channel.topic
                    continue
            yield Seen(channel.topic, schema.name, item.log_time, item.publish_time, value)


def protobuf_class(name: str, descriptors: bytes) -> Any:
    """The class of a message by the descriptors that its channel carries."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


class Cdr:
    """Reads little-endian CDR: each value is aligned to its own size."""

    def __init__(self, data: bytes) -> None:
        assert data[:4] == b"\x00\x01\x00\x00"
        self._body = data[4:]
        self._at = 0

    def take(self, code: str) -> Any:
        """A number, by its letter in `struct`."""
        size = struct.calcsize(f"<{code}")
        self._at += -self._at % size
        (value,) = struct.unpack_from(f"<{code}", self._body, self._at)
        self._at += size
        return value

    def text(self) -> str:
        size = self.take("I")
        value = self._body[self._at : self._at + size]
        assert value.endswith(b"\x00")
        self._at += size
        return value[:-1].decode()

    def many(self, code: str) -> list[Any]:
        return [self.take(code) for _ in range(self.take("I"))]

    def end(self) -> None:
        assert self._at == len(self._body), f"{len(self._body) - self._at} bytes too many"


def _array(cdr: Cdr) -> dict[str, Any]:
    dimensions, offset, data = cdr.take("I"), cdr.take("I"), cdr.many("d")
    cdr.end()
    return {"dim": [None] * dimensions, "data_offset": offset, "data": data}


def _joint_state(cdr: Cdr) -> dict[str, Any]:
    stamp, frame_id = (cdr.take("i"), cdr.take("I")), cdr.text()
    names = [cdr.text() for _ in range(cdr.take("I"))]
    position, velocity, effort = (cdr.many("d") for _ in range(3))
    cdr.end()
    found = {"stamp": stamp, "frame_id": frame_id, "name": names, "position": position}
    return found | {"velocity": velocity, "effort": effort}


_ROS = {"std_msgs/msg/Float64MultiArray": _array, "sensor_msgs/msg/JointState": _joint_state}
