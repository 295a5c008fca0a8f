"""Writing one segment of a recording: an MCAP file that is durable up to its last flush."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import IO, Any, cast

from foxglove.messages import CompressedImage, Timestamp
from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer

from broker_config.codec import SCHEMA_VERSION
from broker_config.durable import sync_folder
from broker_config.messages import View
from broker_config.recording_format import MESSAGE_ENCODING, PROFILE, Facts
from broker_config.version import VERSION

FACTS_METADATA = "clothbus.facts"
"""Name of the MCAP metadata that holds a segment's `Facts`."""

CHUNK_BYTES = 1 << 20
_SEQUENCE_MODULUS = 1 << 32
_NS_PER_SEC = 1_000_000_000


class _WholeWrites:
    """A file without a buffer of ours: what failed to be written is not tried again at `close`."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self._size = 0

    def write(self, data: bytes) -> int:
        """Writes all of it.

        Raises:
            OSError: The disk refuses.
        """
        rest = memoryview(data)
        while rest:
            written = self._file.write(rest)
            self._size += written
            rest = rest[written:]
        return len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Nothing waits here."""

    def sync(self) -> None:
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


class SegmentWriter:
    """Writes a new segment.

    After an `OSError` it can only be closed; what was synced before is whole on the disk.
    """

    def __init__(self, path: Path) -> None:
        """Makes the file, in place of one of that name.

        Raises:
            OSError: The disk refuses.
        """
        self.path = path
        self._file = _WholeWrites(path)
        # The library asks for a file, and uses these three methods of one.
        output = cast(IO[Any], self._file)
        self._mcap = Writer(
            output, CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._copied_schemas: dict[int, int] = {}
        self._copied_channels: dict[int, int] = {}
        try:
            self._mcap.start(PROFILE, f"clothbus {VERSION}")
            sync_folder(path.parent)
        except OSError:
            self.close()
            raise

    @property
    def size_bytes(self) -> int:
        """Of the file as it is, without the chunk that is being filled."""
        return self._file.tell()

    def add(
        self,
        topic: str,
        message_name: str,
        payload: bytes,
        sequence: int = 0,
        publish_time_ns: int | None = None,
    ) -> None:
        """Adds an encoded message.

        Args:
            topic: Under which it is found.
            message_name: The name of its class.
            payload: What the codec made of it.
            sequence: A number that its origin gave it.
            publish_time_ns: When it came to be; the time of this call if None.

        Raises:
            OSError: The disk refuses.
        """
        if (channel := self._channels.get(topic)) is None:
            channel = self._msgpack_channel(topic, message_name)
        self._add(channel, payload, sequence, publish_time_ns)

    def add_image(self, topic: str, view: View) -> None:
        """Adds a view's picture as viewers know it.

        Raises:
            OSError: The disk refuses.
        """
        if (channel := self._channels.get(topic)) is None:
            channel = self._image_channel(topic)
        publish_time_ns = to_ns(view.unix_secs)
        image = CompressedImage(
            timestamp=Timestamp(*divmod(publish_time_ns, _NS_PER_SEC)),
            frame_id=view.actor,
            data=view.picture,
            format=view.picture_format,
        )
        self._add(channel, image.encode(), view.sequence, publish_time_ns)

    def copy(self, record: Schema | Channel | Message) -> None:
        """Adds a record of another segment, with its times.

        Raises:
            OSError: The disk refuses.
        """
        match record:
            case Schema():
                self._copied_schemas[record.id] = self._mcap.register_schema(
                    record.name, record.encoding, record.data
                )
            case Channel():
                schema = self._copied_schemas[record.schema_id]
                self._copied_channels[record.id] = self._mcap.register_channel(
                    record.topic, record.message_encoding, schema, record.metadata
                )
            case Message():
                self._mcap.add_message(
                    self._copied_channels[record.channel_id],
                    record.log_time,
                    record.data,
                    record.publish_time,
                    record.sequence,
                )

    def flush(self) -> None:
        """Makes everything so far durable.

        Raises:
            OSError: The disk refuses.
        """
        self._mcap.flush()  # type: ignore[no-untyped-call]  # mcap leaves its return type out
        self._file.sync()

    def finish(self, facts: Facts) -> None:
        """Adds what is told of the segment, and its index; durable on return. Then `close`.

        Raises:
            OSError: The disk refuses.
        """
        self._mcap.flush()  # type: ignore[no-untyped-call]  # likewise
        self._mcap.add_metadata(FACTS_METADATA, facts.to_metadata())
        self._mcap.finish()  # type: ignore[no-untyped-call]  # likewise
        self._file.sync()

    def close(self) -> None:
        """Closes the file, finished or not."""
        self._file.close()

    def _add(
        self, channel: int, payload: bytes, sequence: int, publish_time_ns: int | None
    ) -> None:
        now_ns = max(0, time.time_ns())
        published_ns = now_ns if publish_time_ns is None else publish_time_ns
        self._mcap.add_message(channel, now_ns, payload, published_ns, sequence % _SEQUENCE_MODULUS)

    def _msgpack_channel(self, topic: str, message_name: str) -> int:
        name = f"clothbus.{message_name}"
        if name not in self._schemas:
            self._schemas[name] = self._mcap.register_schema(name, "", b"")
        metadata = {"message": message_name, "schema_version": str(SCHEMA_VERSION)}
        return self._register(topic, MESSAGE_ENCODING, self._schemas[name], metadata)

    def _image_channel(self, topic: str) -> int:
        schema = CompressedImage.get_schema()
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._mcap.register_schema(
                schema.name, schema.encoding, schema.data
            )
        return self._register(topic, "protobuf", self._schemas[schema.name], {})

    def _register(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        channel = self._mcap.register_channel(topic, encoding, schema, metadata)
        self._channels[topic] = channel
        return channel


def to_ns(unix_secs: float) -> int:
    """A wall clock's time as MCAP holds it; what lies before 1970 or after 2500 is cut off."""
    return round(min(max(unix_secs, 0.0), 16.7e9) * _NS_PER_SEC)
