"""Republishes what a recording has of a run's live traffic: `clothbus replay --view`.

Views, metrics, policies, discriminators and presence come again under another run's name, in the
order of the recording, for consoles and viewers. Nothing is learned from it: who asks for tickets
gets no answer.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

from broker_config.bus import Bus, Publisher
from broker_config.codec import decode
from broker_config.heart import Heart, Pulse
from broker_config.messages import (
    JournalEntry,
    Metrics,
    Presence,
    Rewards,
    Role,
    Snapshot,
    View,
)
from broker_config.recording.format import SNAPSHOT_TOPIC, RecordedMessage
from broker_config.recording.recording import iter_recording
from discriminator.labelling import snapshot_of

_log = logging.getLogger(__name__)

TOPICS = ("view/", "metrics/", "presence", SNAPSHOT_TOPIC, "journal/rewards")
LONGEST_PAUSE_SECS = 10.0
"""Of a recording: a run that was resumed the next day is not waited for so long."""

LONGEST_WAIT_SECS = 0.2
"""Between two looks at whether to stop."""

Join = Callable[[Role, str], Bus]
"""Gives a place on the bus, as this role and under this name."""


class ViewReplay:
    """One pass over a recording.

    Attributes:
        published: Messages so far, by what they are.
    """

    def __init__(self, recording: Path, join: Join, stop: threading.Event) -> None:
        """Prepares it.

        Args:
            recording: A recording's folder.
            join: Where the replayed processes appear; closed by whoever gave it.
            stop: Ends it when set.
        """
        self._recording = recording
        self._join = join
        self._stop = stop
        self._buses: dict[tuple[str, str], Bus] = {}
        self._hearts: dict[tuple[str, str], ExitStack] = {}
        self._publishers: dict[str, Publisher] = {}
        self.published: dict[str, int] = {}

    def play(self, wait: Callable[[int], None]) -> bool:
        """Publishes everything.

        Args:
            wait: Called before each message with its time in the recording, ns; returns when its
                turn has come.

        Returns:
            Whether all was published; False when it was stopped.

        Raises:
            StorageError: The recording is damaged.
        """
        try:
            for recorded in self._messages():
                wait(recorded.log_time_ns)
                if self._stop.is_set():
                    return False
                self._publish(recorded.decode())
        finally:
            for heart in self._hearts.values():
                heart.close()
        return True

    def _messages(self) -> Iterator[RecordedMessage]:
        for recorded in iter_recording(self._recording, TOPICS):
            if recorded.encoding == "msgpack":  # what else there is, viewers make from these
                yield recorded

    def _publish(self, message: object) -> None:
        match message:
            case View():
                self._publisher("actor", message.actor, "view").put(message)
            case Metrics():
                self._publisher(message.role, message.id, "metrics").put(message)
            case Snapshot():
                self._publisher("owner", "learner", "policy").put(message)
            case Presence():
                self._come_or_go(message)
            case JournalEntry() as entry:
                rewards = decode(entry.payload, Rewards)
                publisher = self._publisher("discriminator", rewards.discriminator, "newest")
                publisher.put(snapshot_of(rewards))
        name = type(message).__name__
        self.published[name] = self.published.get(name, 0) + 1

    def _publisher(self, role: Role, id_: str, what: str) -> Publisher:
        bus = self._bus(role, id_)
        key = {
            "view": lambda: bus.keys.view(id_),
            "metrics": lambda: bus.keys.metrics(role, id_),
            "policy": lambda: bus.keys.policy,
            "newest": lambda: bus.keys.discriminators,
        }[what]()
        if key not in self._publishers:
            is_latest = what in ("policy", "newest")
            publish = bus.latest_publisher if is_latest else bus.publisher
            self._publishers[key] = publish(key)
        return self._publishers[key]

    def _bus(self, role: Role, id_: str) -> Bus:
        if (role, id_) not in self._buses:
            self._buses[role, id_] = self._join(role, id_)
        return self._buses[role, id_]

    def _come_or_go(self, presence: Presence) -> None:
        process = presence.role, presence.id
        if (heart := self._hearts.pop(process, None)) is not None:
            heart.close()
        if presence.is_alive:
            stack = ExitStack()
            bus = stack.enter_context(self._join(*process))
            pulse = Pulse()

            def vitals() -> tuple[str, dict[str, float]]:
                pulse.beat()
                return "replayed", {}

            stack.enter_context(Heart(bus, *process, "replayed", vitals, pulse))
            self._hearts[process] = stack


def paced(speed: float, stop: threading.Event) -> Callable[[int], None]:
    """Waits as long between two messages as there was between them, divided by the speed.

    Args:
        speed: 1 is the run's own pace; infinite for no waiting.
        stop: Ends the waiting when set.
    """
    due_secs = time.monotonic()
    last_ns: int | None = None

    def wait(at_ns: int) -> None:
        nonlocal due_secs, last_ns
        # A recorder's clock may jump backwards: then nothing is waited for.
        pause_secs = 0.0 if last_ns is None else max(0.0, (at_ns - last_ns) / 1e9 / speed)
        last_ns = at_ns
        if pause_secs > LONGEST_PAUSE_SECS:
            _log.info("Passing over a pause of %.0f s", pause_secs)
        due_secs += min(pause_secs, LONGEST_PAUSE_SECS)
        while not stop.is_set() and (left_secs := due_secs - time.monotonic()) > 0:
            stop.wait(min(left_secs, LONGEST_WAIT_SECS))

    return wait
