"""Joining a run: what any process asks before it says anything else, and when the owner says no.

And how it asks whatever it has to ask: until the owner answers.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import TypeVar

from broker_config.bus import Bus
from broker_config.codec import SCHEMA_VERSION
from broker_config.errors import AttachRefused, OwnerUnreachable, Refused
from broker_config.messages import Attach, Refusal, Role, Welcome
from broker_config.preset import Preset
from broker_config.version import VERSION

_log = logging.getLogger(__name__)

R = TypeVar("R")

ATTACH_TIMEOUT_SECS = 3.0
RETRY_SECS = 0.5

PATIENCE_SECS = 3.0
"""A refusal is asked again for so long: a killed process of the same name may still seem alive."""


class StopRequested(Exception):
    """The process was asked to leave in the middle of something."""


def insist(
    ask: Callable[[], R],
    stop: threading.Event,
    on_try: Callable[[], None],
    on_silence: Callable[[], None],
) -> R:
    """Asks until the owner answers: whoever has nothing to lose can wait for as long as it takes.

    Args:
        ask: Asks once; safe to repeat.
        stop: Set when the process is to leave.
        on_try: Called before each question: waiting is no standstill.
        on_silence: Called after each question that nobody has answered.

    Raises:
        StopRequested: `stop` is set.
    """
    has_said = False
    while not stop.is_set():
        on_try()
        try:
            return ask()
        except OwnerUnreachable as error:
            on_silence()
            _log.log(logging.DEBUG if has_said else logging.INFO, "Waiting: %s", error)
            has_said = True
            stop.wait(RETRY_SECS)
    raise StopRequested


def attach(
    bus: Bus,
    role: Role,
    process_id: str,
    incarnation: str,
    preset: Preset | None,
    wait: Callable[[float], bool],
) -> Welcome:
    """Asks the run's owner whether this process may join.

    Args:
        bus: The process's place on the bus.
        role: As what it joins.
        process_id: Under which name.
        incarnation: Of this process; another for every start.
        preset: What the run must be, or None to take what it is.
        wait: Pauses for so many seconds, and says whether to give up instead of asking again.

    Raises:
        AttachRefused: Versions or presets differ, or the name is taken.
        OwnerUnreachable: There is no owner now; asking again is safe.
    """
    request = Attach(
        role=role,
        id=process_id,
        incarnation=incarnation,
        schema_version=SCHEMA_VERSION,
        software_version=VERSION,
        preset_digest=preset.digest if preset else "",
    )
    key = bus.keys.attach(role, process_id)
    give_up_secs = time.monotonic() + PATIENCE_SECS
    while True:
        try:
            return bus.ask(key, request, Welcome, timeout_secs=ATTACH_TIMEOUT_SECS)
        except Refused as error:
            if time.monotonic() > give_up_secs or wait(RETRY_SECS):
                raise AttachRefused(f"run {bus.keys.run}: {error}") from error


def refusal(request: Attach, preset: Preset) -> Refusal | None:
    """Why a process must not join a run of this preset; None if it may."""
    if request.schema_version != SCHEMA_VERSION:
        rule = "schema version", str(SCHEMA_VERSION), str(request.schema_version)
    elif request.software_version != VERSION:
        rule = "clothbus version", VERSION, request.software_version
    elif request.preset_digest not in ("", preset.digest):
        advice = f"start {request.id} without a preset: it then takes the run's"
        return Refusal("preset digest", preset.digest, request.preset_digest, advice)
    else:
        return None
    return Refusal(*rule, "install the same clothbus version on both machines")
