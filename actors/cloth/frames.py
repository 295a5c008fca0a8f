"""Messages of known length over the pipe between an engine's process and its owner."""

import os
import select
import time

HEADER_BYTES = 4
LARGEST_BYTES = 1 << 26  # 64 MiB: a million vertices; more is a broken header


def write_frame(descriptor: int, payload: bytes) -> None:
    """Write one message.

    Raises:
        BrokenPipeError: the other side is gone.
    """
    rest = memoryview(len(payload).to_bytes(HEADER_BYTES, "big") + payload)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


def read_frame(descriptor: int, timeout_secs: float | None = None) -> bytes:
    """Read one message; without a timeout wait for as long as it takes.

    Raises:
        EOFError: the other side is gone.
        TimeoutError: the whole message was not there in time.
        ValueError: the length is out of the rule, so that the stream is broken.
    """
    deadline = None if timeout_secs is None else time.monotonic() + timeout_secs
    length = int.from_bytes(_read_exactly(descriptor, HEADER_BYTES, deadline), "big")
    if length > LARGEST_BYTES:
        raise ValueError(
            f"frame: expected at most {LARGEST_BYTES} bytes; got {length}; "
            "something else writes to this pipe"
        )
    return _read_exactly(descriptor, length, deadline)


def _read_exactly(descriptor: int, n_bytes: int, deadline: float | None) -> bytes:
    parts = bytearray()
    while len(parts) < n_bytes:
        remaining_secs = None if deadline is None else max(0.0, deadline - time.monotonic())
        if not select.select([descriptor], [], [], remaining_secs)[0]:
            raise TimeoutError(f"frame: expected {n_bytes} bytes; got {len(parts)} in time")
        part = os.read(descriptor, n_bytes - len(parts))
        if not part:
            raise EOFError(f"frame: expected {n_bytes} bytes; got {len(parts)} before the end")
        parts += part
    return bytes(parts)
