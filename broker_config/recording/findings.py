"""What a check of a recording finds, and what its rules are made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

from broker_config.recording.format import SNAPSHOT_TOPIC, Excerpt, is_wanted


@dataclass(frozen=True)
class Finding:
    """Something that a check found."""

    text: str
    """What was expected, and what came."""
    is_fault: bool = True
    """Whether the recording is not whole because of it; else it is only worth knowing."""
    where: str = ""


@dataclass(frozen=True)
class Heard:
    """A message of a recording, decoded."""

    message: object
    entry: object | None
    """Of a journal entry, the message in it; None if it is none that can be read."""
    topic: str
    sequence: int

    @property
    def content(self) -> object:
        """What is in the journal entry, or else the message."""
        return self.message if self.entry is None else self.entry


@dataclass(frozen=True)
class Extent:
    """How much of a run what is checked should hold."""

    is_folder: bool
    """False for a segment by itself: what comes after it is in others."""
    begins_at_0: bool
    """False for a later segment by itself: what it goes on from is in others."""
    slice_: Excerpt | None
    """For a slice: which part of a recording it is."""

    @property
    def is_whole(self) -> bool:
        """Whether everything from the beginning should be there."""
        return self.begins_at_0 and self.slice_ is None

    @property
    def has_weights(self) -> bool:
        """Whether the weights of each policy version that is named should be there."""
        if self.slice_ is None:
            return self.begins_at_0
        return is_wanted(SNAPSHOT_TOPIC, self.slice_.topics)


class Rule(ABC):
    """Something that must hold."""

    def __init__(self, extent: Extent) -> None:
        self._extent = extent

    def hear(self, heard: Heard) -> Iterator[Finding]:
        """Takes in the next message."""
        yield from self._hear(heard)

    def end(self) -> Iterator[Finding]:
        """Nothing more comes."""
        yield from self._end()

    @abstractmethod
    def _hear(self, heard: Heard) -> Iterator[Finding]: ...

    def _end(self) -> Iterator[Finding]:
        yield from ()
