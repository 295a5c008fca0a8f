"""Places where tests end a process as a crash would: between each two steps of the commit order.

Without the environment variable, reaching one costs a look at an empty table.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from broker_config.errors import ConfigurationError

FAILPOINT_VARIABLE = "CLOTHBUS_FAILPOINTS"
"""`point:count:flag file;...`: kill -9 when the point is reached for the count-th time.

The flag file is made first, and a failpoint whose flag file exists is spent: a process that is
started again gets past it.
"""


class Failpoint(StrEnum):
    """Each is named for what has just been done."""

    # The actor
    SPOOL_RECOVERED = "spool-recovered"
    TICKET_RECEIVED = "ticket-received"
    EPISODE_PLAYED = "episode-played"
    EPISODE_SPOOLED = "episode-spooled"
    TRAJECTORY_SENT = "trajectory-sent"
    ACK_RECEIVED = "ack-received"
    # The learner, when asked
    TRAJECTORY_RECEIVED = "trajectory-received"
    TRAJECTORY_JOURNALED = "trajectory-journaled"
    TICKET_JOURNALED = "ticket-journaled"
    REWARDS_RECEIVED = "rewards-received"
    REWARDS_JOURNALED = "rewards-journaled"
    # The learner, of itself
    EPISODE_ABSORBED = "episode-absorbed"
    ITERATION_ANNOUNCED = "iteration-announced"
    POLICY_UPDATED = "policy-updated"
    FILE_WRITTEN = "file-written"
    CHECKPOINT_SAVED = "checkpoint-saved"
    SNAPSHOT_STORED = "snapshot-stored"
    ITERATION_JOURNALED = "iteration-journaled"
    SNAPSHOT_JOURNALED = "snapshot-journaled"
    SNAPSHOT_PUBLISHED = "snapshot-published"
    # The discriminator service
    ANNOUNCEMENT_FOLLOWED = "announcement-followed"
    REWARDS_MADE = "rewards-made"
    REWARDS_ACKED = "rewards-acked"
    DISCRIMINATORS_PUBLISHED = "discriminators-published"
    # The recorder
    BATCH_RECEIVED = "batch-received"
    BATCH_WRITTEN = "batch-written"
    BATCH_HELD = "batch-held"
    RECORDING_RECOVERED = "recording-recovered"
    # The evaluator
    EVALUATION_PLAYED = "evaluation-played"
    EVALUATION_WRITTEN = "evaluation-written"


@dataclass
class _Armed:
    left: int
    flag: Path


def reach(point: Failpoint) -> None:
    """Ends the process with `kill -9` if the environment says so for this point."""
    if _armed and (armed := _armed.get(point)) is not None:
        armed.left -= 1
        if armed.left <= 0 and _spend(armed.flag):
            os.kill(os.getpid(), signal.SIGKILL)


def _spend(flag: Path) -> bool:
    try:
        flag.touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def read_armed(environment: Mapping[str, str]) -> dict[Failpoint, _Armed]:
    """What the environment variable arms.

    Raises:
        ConfigurationError: It names no failpoint, or is of another form.
    """
    armed = {}
    for part in filter(None, environment.get(FAILPOINT_VARIABLE, "").split(";")):
        name, _, rest = part.partition(":")
        count, _, flag = rest.partition(":")
        if name not in list(Failpoint) or not count.isdigit() or not flag:
            raise ConfigurationError(
                f"{FAILPOINT_VARIABLE}: expected point:count:flag file with one of "
                f"{', '.join(Failpoint)}; got {part!r}; unset it outside tests"
            )
        armed[Failpoint(name)] = _Armed(int(count), Path(flag))
    return armed


_armed = read_armed(os.environ)
