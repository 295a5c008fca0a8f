"""What a run that does not act learns from: kept in its folder, so that it stays the same."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, replace

from broker_config.durable import write_durably
from broker_config.errors import MessageError, StorageError
from broker_config.messages import TrajectoryId
from broker_config.structure import from_plain, to_plain
from deploy.offline.recorded_episodes import RecordedEpisodes
from deploy.run_folder import RunFolder
from learner.recorded import Demonstrations


@dataclass(frozen=True)
class OfflineOrigin:
    """What a run folder learns from, so that it never goes on with anything else."""

    sources: tuple[str, ...]
    """Paths, for a person; what they hold is what counts."""
    episodes_digest: str
    """SHA-256 over the ids of all trajectories, in the order in which they are learned from."""
    reward: str | None
    """As it was named; None for what the preset says."""
    demonstrations_digest: str
    """Likewise of the demonstrations."""

    @property
    def command(self) -> str:
        """With which the run goes on, but for --output."""
        reward = f" --reward {self.reward}" if self.reward else ""
        return f"clothbus train --from {' '.join(self.sources)}{reward}"


def origin_of(
    episodes: RecordedEpisodes, demonstrations: Demonstrations | None, reward: str | None
) -> OfflineOrigin:
    """What a run would learn from."""
    given = demonstrations.trajectories if demonstrations else ()
    return OfflineOrigin(
        tuple(str(run.path) for run in episodes.runs),
        _digest(id_ for run in episodes.runs for id_ in run.ids),
        reward,
        _digest(each.id for each in given),
    )


def keep_origin(folder: RunFolder, origin: OfflineOrigin) -> None:
    """Notes what a folder learns from, before it learns.

    Raises:
        StorageError: It has learned from something else, or has acted.
    """
    if folder.offline.exists():
        kept = read_origin(folder)
        if replace(kept, sources=origin.sources) != origin:
            raise StorageError(
                f"{folder.path}: expected the episodes, rewards and demonstrations with which it "
                f"was begun, {kept.command}; got others; learn from them into another folder"
            )
        return
    if folder.journal.exists():
        raise StorageError(
            f"{folder.path}: expected a folder that has learned from recordings alone; got a "
            "run's; name another with --output"
        )
    write_durably(folder.offline, json.dumps(to_plain(origin), indent=2).encode())


def read_origin(folder: RunFolder) -> OfflineOrigin:
    """What `keep_origin` wrote.

    Raises:
        StorageError: The file holds something else.
    """
    try:
        plain = json.loads(folder.offline.read_text())
        return from_plain(plain, OfflineOrigin, folder.offline.name)
    except (OSError, ValueError, MessageError) as error:
        raise StorageError(
            f"{folder.offline}: expected what this run learns from; got {error}; the folder is "
            "damaged"
        ) from error


def _digest(ids: Iterable[TrajectoryId]) -> str:
    return hashlib.sha256("\n".join(map(str, ids)).encode()).hexdigest()
