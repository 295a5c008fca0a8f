"""`clothbus replay`: from its arguments to its end."""

from __future__ import annotations

import select
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from broker_config.bus import open_bus, open_places
from broker_config.errors import AlreadyOwned, StorageError
from broker_config.journal import JOURNAL_FILE
from deploy.commands.status import only_run
from deploy.offline.recorded_episodes import read_episodes
from deploy.offline.replay_actor import ReplayActor
from deploy.offline.replay_view import LONGEST_WAIT_SECS, ViewReplay, paced
from deploy.process import on_terminate
from deploy.run_folder import RunFolder


def replay_as_actors(
    paths: Sequence[Path],
    address: str,
    run: str | None,
    name: str,
    overrides: tuple[str, ...],
    console: Console,
) -> bool:
    """Answers a live learner's tickets with recorded episodes.

    Returns:
        Whether there is nothing more to deliver; False when it was asked to leave.

    Raises:
        AttachRefused: The owner's versions differ, or the name is taken.
        OwnerUnreachable: The router carries no run, or several and none was named.
        PresetError: The run is of another task than what was recorded.
        RouterUnreachable: There is no router at the address.
        StorageError: A source is damaged, or none.
    """
    episodes = read_episodes(paths)
    run = run or only_run(address, overrides)
    with open_bus(address, run, "actor", name, overrides) as bus:
        actor = ReplayActor(bus, name, episodes)
        on_terminate(actor.stop)
        has_finished = actor.run()
    done = actor.delivered
    console.print(
        f"Delivered {done.accepted} trajectories of {len(episodes)} recorded episodes; "
        f"{done.refused} were not taken; {done.on_other_policies} had been played by another "
        "policy than the learner's",
        highlight=False,
        soft_wrap=True,
    )
    return has_finished


def replay_as_views(
    source: Path,
    address: str,
    run: str | None,
    speed: float,
    step: bool,
    overrides: tuple[str, ...],
    console: Console,
) -> bool:
    """Publishes a recording's live traffic under a run's name.

    Returns:
        Whether all was published; False when it was asked to leave.

    Raises:
        RouterUnreachable: There is no router at the address.
        StorageError: There is no recording, or it is damaged.
    """
    recording = source / "recording" if (source / "recording").is_dir() else source
    if run is None:
        of_run = source if recording != source else _run_of(source)
        run = f"{RunFolder(of_run.resolve()).run[:57]}-replay"
    if not recording.exists() or (recording / JOURNAL_FILE).is_file():
        raise StorageError(
            f"{source}: expected a recording, or a run's folder with one; got none; a run in one "
            "process is not recorded"
        )
    stop = threading.Event()
    on_terminate(stop.set)
    console.print(f"Replaying {recording} as run {run}", highlight=False, soft_wrap=True)
    with open_places(address, run, overrides) as join:
        if any(key.role == "owner" for key in join("observer", "replay").alive()):
            raise AlreadyOwned(
                f"run {run}: expected a name that no living run has; got one whose owner is there; "
                "choose another with --run"
            )
        replay = ViewReplay(recording, join, stop)
        is_whole = replay.play(_wait_for_enter(stop) if step else paced(speed, stop))
    counts = ", ".join(f"{count} {name}" for name, count in replay.published.items())
    console.print(f"Published {counts or 'nothing'}", highlight=False)
    return is_whole


def _run_of(recording: Path) -> Path:
    """The folder of a recording's run, or of one of its segments'."""
    folder = recording.parent if recording.suffix == ".mcap" else recording
    return folder.parent if folder.name == "recording" else folder


def _wait_for_enter(stop: threading.Event) -> Callable[[int], None]:
    def wait(_: int) -> None:
        while not stop.is_set():
            # Not simply read: a signal would not end that.
            if select.select([sys.stdin], [], [], LONGEST_WAIT_SECS)[0]:
                if not sys.stdin.readline():
                    stop.set()  # nobody is there to press it
                return

    return wait
