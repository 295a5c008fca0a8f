import os
from collections.abc import Iterator

import pytest

from actors.cloth.frames import read_frame, write_frame


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    reader, writer = os.pipe()
    yield reader, writer
    for descriptor in (reader, writer):
        try:
            os.close(descriptor)
        except OSError:
            continue


def test_frames_come_out_as_they_went_in(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    payloads = [b"", b"cloth", bytes(range(256)) * 20]
    for payload in payloads:
        write_frame(writer, payload)
    assert [read_frame(reader, 1.0) for _ in payloads] == payloads


def test_an_end_within_a_frame_is_an_end(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    os.write(writer, b"\0\0\0\x09half")
    os.close(writer)
    with pytest.raises(EOFError, match="expected 9 bytes; got 4"):
        read_frame(reader)


def test_a_frame_that_does_not_come_is_not_waited_for(pipe: tuple[int, int]) -> None:
    with pytest.raises(TimeoutError):
        read_frame(pipe[0], timeout_secs=0.01)


def test_text_in_the_pipe_is_recognised(pipe: tuple[int, int]) -> None:
    os.write(pipe[1], b"pybullet build time")
    with pytest.raises(ValueError, match="something else writes to this pipe"):
        read_frame(pipe[0], 1.0)
