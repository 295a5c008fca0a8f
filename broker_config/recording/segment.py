"""Writing one segment of a recording: an MCAP file that is durable up to its last flush."""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path
from typing import IO, Any, cast

from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer

from broker_config.codec import SCHEMA_VERSION
from broker_config.durable import sync_folder
from broker_config.recording.format import MESSAGE_ENCODING, PROFILE, Excerpt, Facts
from broker_config.recording.viewers import Form, Shown
from broker_config.version import VERSION

_log = logging.getLogger(__name__)

FACTS_METADATA = "clothbus.facts"
"""Name of the MCAP metadata that holds a segment's `Facts`."""

EXCERPT_METADATA = "clothbus.excerpt"
"""Name of the MCAP metadata of a segment that was copied: its `Excerpt`."""

MESSAGE_FIELD = "message"
SCHEMA_VERSION_FIELD = "schema_version"
"""What the metadata of a channel of the codec's messages says of them."""

CHUNK_BYTES = 1 << 20

MOST_CHANNELS = 1 << 14
"""MCAP counts channels with 16 bits. Names of numbers are a sender's, and what viewers see of them
must not stop a recorder: beyond this, new ones are left out."""

SEQUENCE_MODULUS = 1 << 32
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
        self._has_left_out = False
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
        log_time_ns: int | None = None,
    ) -> None:
        """Adds an encoded message.

        Args:
            topic: Under which it is found.
            message_name: The name of its class.
            payload: What the codec made of it.
            sequence: A number that its origin gave it.
            publish_time_ns: When it came to be; the time of this call if None.
            log_time_ns: When it was heard; the time of this call if None.

        Raises:
            OSError: The disk refuses.
        """
        if (channel := self._channels.get(topic)) is None:
            channel = self._msgpack_channel(topic, message_name)
        self._add(channel, payload, sequence, publish_time_ns, log_time_ns)

    def add_shown(
        self,
        shown: Shown,
        sequence: int,
        publish_time_ns: int | None = None,
        log_time_ns: int | None = None,
    ) -> None:
        """Adds a message for viewers; times and number are of the message that it is of.

        Raises:
            OSError: The disk refuses.
        """
        if (channel := self._channels.get(shown.topic)) is None:
            if len(self._channels) >= MOST_CHANNELS:
                self._leave_out(shown.topic)
                return
            channel = self._register(
                shown.topic, shown.form.encoding, self._schema_of(shown.form), {}
            )
        self._add(channel, shown.payload, sequence, publish_time_ns, log_time_ns, shown.secs_before)

    def copy(self, schema: Schema | None, channel: Channel, message: Message) -> None:
        """Adds a message of another segment, under its topic and with its times.

        Raises:
            OSError: The disk refuses.
        """
        copied = self._channels.get(channel.topic)
        if copied is None:
            schema_id = 0 if schema is None else self._known_schema(schema)
            copied = self._register(
                channel.topic, channel.message_encoding, schema_id, channel.metadata
            )
        self._mcap.add_message(
            copied, message.log_time, message.data, message.publish_time, message.sequence
        )

    def flush(self) -> None:
        """Makes everything so far durable.

        Raises:
            OSError: The disk refuses.
        """
        self._mcap.flush()  # type: ignore[no-untyped-call]  # mcap leaves its return type out
        self._file.sync()

    def finish(self, facts: Facts, excerpt: Excerpt | None = None) -> None:
        """Adds what is told of the segment, and its index; durable on return. Then `close`.

        Args:
            facts: Of the segment.
            excerpt: What it was copied from, if it is no recorder's.

        Raises:
            OSError: The disk refuses.
        """
        self._mcap.flush()  # type: ignore[no-untyped-call]  # likewise
        self._mcap.add_metadata(FACTS_METADATA, facts.to_metadata())
        if excerpt is not None:
            self._mcap.add_metadata(EXCERPT_METADATA, excerpt.to_metadata())
        self._mcap.finish()  # type: ignore[no-untyped-call]  # likewise
        self._file.sync()

    def close(self) -> None:
        """Closes the file, finished or not."""
        self._file.close()

    def _add(
        self,
        channel: int,
        payload: bytes,
        sequence: int,
        publish_time_ns: int | None,
        log_time_ns: int | None,
        secs_before: float = 0.0,
    ) -> None:
        now_ns, before_ns = time.time_ns(), round(secs_before * _NS_PER_SEC)
        logged_ns = now_ns if log_time_ns is None else log_time_ns
        published_ns = now_ns if publish_time_ns is None else publish_time_ns
        self._mcap.add_message(
            channel,
            max(0, logged_ns - before_ns),
            payload,
            max(0, published_ns - before_ns),
            sequence % SEQUENCE_MODULUS,
        )

    def _msgpack_channel(self, topic: str, message_name: str) -> int:
        schema, channel = channel_of(topic, message_name)
        known = self._known_schema(schema)
        return self._register(topic, channel.message_encoding, known, channel.metadata)

    def _leave_out(self, topic: str) -> None:
        if not self._has_left_out:
            _log.warning("%s: viewers will miss %r: there are too many topics", self.path, topic)
        self._has_left_out = True

    def _schema_of(self, form: Form) -> int:
        return self._known_schema(Schema(0, form.schema, form.schema_encoding, form.schema_name))

    def _known_schema(self, schema: Schema) -> int:
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._mcap.register_schema(
                schema.name, schema.encoding, schema.data
            )
        return self._schemas[schema.name]

    def _register(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        channel = self._mcap.register_channel(topic, encoding, schema, metadata)
        self._channels[topic] = channel
        return channel


def channel_of(topic: str, message_name: str) -> tuple[Schema, Channel]:
    """What tells of the codec's messages of a topic; without numbers, which each file has anew."""
    schema = Schema(0, b"", "", f"clothbus.{message_name}")
    metadata = {MESSAGE_FIELD: message_name, SCHEMA_VERSION_FIELD: str(SCHEMA_VERSION)}
    return schema, Channel(0, topic, MESSAGE_ENCODING, metadata, 0)


def to_ns(unix_secs: float) -> int:
    """A wall clock's time as MCAP holds it; what lies before 1970 or after 2500 is cut off."""
    return round(min(max(unix_secs, 0.0), 16.7e9) * _NS_PER_SEC)
