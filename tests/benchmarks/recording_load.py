"""Recording beside training: 500 messages a second of 21 KB, and a recorder that is killed.

    python -m tests.benchmarks.recording_load --secs 120

Light actors deliver trajectories, a process shows views at the same size, and the learner trains
after each hundred; all of it, with router and recorder, on the cores of this machine. In the middle
the recorder is killed and started again. In the end the recording must hold the whole journal,
once, in order. The lag of an entry is from its commit to its writing.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from broker_config.bus import Bus, open_bus
from broker_config.errors import OwnerUnreachable
from broker_config.journal import JOURNAL_FILE
from broker_config.messages import Command, JournalEntry, View
from broker_config.recording.recording import iter_recording
from deploy.commands.status import send_control
from tests.benchmarks.light_actors import RUN, start_actors, wait_for_learner
from tests.benchmarks.measuring import RESULTS, Processes, cpu_secs_of, keep_result, percentile
from tests.process.recorded import settle_recording

VIEW_BYTES = 21_000
VIEWERS = 4
ACTORS = 20
DOWN_SECS = 1.0
END_SECS = 180.0
SETTINGS = (
    "task.horizon=2",
    "schedule.iterations=100000",
    "schedule.update_every=iteration",
    "schedule.episodes_per_iteration=100",
    "schedule.policy_lag=400",
    "schedule.memory_samples=400",
    "schedule.target_switches=1",
    "schedule.epochs=1",
    "schedule.minibatch_size=32",
)
"""An iteration of a hundred trajectories every second, each followed by half a second of training;
actors may be four iterations ahead, so that a slow update holds nobody up."""


def show_views(arguments: argparse.Namespace) -> None:
    """Publishes views at a steady rate, under several names."""
    pictures = np.random.default_rng(0).bytes(VIEW_BYTES)
    with open_bus(arguments.address, RUN, "observer", "viewers") as bus:
        threads = [
            threading.Thread(target=_show, args=[bus, name, pictures, arguments])
            for name in viewer_names()
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()


def viewer_names() -> list[str]:
    return [f"viewer-{number}" for number in range(VIEWERS)]


def _show(bus: Bus, name: str, picture: bytes, arguments: argparse.Namespace) -> None:
    publisher = bus.publisher(bus.keys.view(name))
    began_secs, rate = time.monotonic(), arguments.views / VIEWERS
    for number in range(int(arguments.secs * rate)):
        time.sleep(max(0.0, began_secs + number / rate - time.monotonic()))
        view = View(name, "life", number, 0, 0, 0, number, 0 if number else None,
                    0.0 if number else None, picture, "jpeg", time.time())  # fmt: skip
        publisher.put(view)


def measure(arguments: argparse.Namespace) -> dict[str, object]:
    """The whole benchmark."""
    with (
        tempfile.TemporaryDirectory(dir=arguments.folder) as name,
        tempfile.TemporaryDirectory(dir="/dev/shm") as spools,
        Processes(Path(name)) as processes,
    ):
        folder = Path(name)
        run_folder, recording = folder / RUN, folder / "recording"
        router, address = processes.router()
        learner = processes.clothbus(
            "learner", "learner", run_folder, "--preset", "reaching-smoke",
            "--connect", address, "--set", *SETTINGS,
        )  # fmt: skip
        wait_for_learner(address, learner)
        recorder = processes.clothbus(
            "recorder", "record", "--run", RUN, "--output", recording, "--connect", address
        )
        load = argparse.Namespace(
            actors=ACTORS, processes=2, secs=arguments.secs, rate=arguments.trajectories / ACTORS
        )
        actors = start_actors(processes, address, load, folder, Path(spools))
        viewers = processes.start(
            "viewers", "-m", "tests.benchmarks.recording_load", "--address", address,
            "--secs", arguments.secs, "--views", arguments.views,
        )  # fmt: skip
        watched = {"learner": learner, "router": router}
        began_secs = time.monotonic()
        with cpu_secs_of(watched) as cpu_secs:
            time.sleep(arguments.secs / 2)
            recorder.kill()
            killed_unix_secs = time.time()
            time.sleep(DOWN_SECS)
            recorder.start()
            for started in [*actors, viewers]:
                started.wait(arguments.secs + END_SECS)
        took_secs = time.monotonic() - began_secs
        _stop(address)
        learner.wait(END_SECS)
        recorder.wait(END_SECS)
        account = settle_recording(recording, run_folder / JOURNAL_FILE)
        lags, caught_up_secs = _lags(recording, killed_unix_secs)
        views = sum(account.topics[f"view/{name}"] for name in viewer_names())
        sent_views = int(arguments.secs * arguments.views / VIEWERS) * VIEWERS
        return {
            "secs": round(took_secs, 1),
            "messages_per_sec": round((account.trajectories + sent_views) / took_secs, 1),
            "trajectories": account.trajectories,
            "journal_entries_recorded": account.entries,
            "journal_entries_lost": 0,  # or settle_recording would have failed
            "views_sent": sent_views,
            "views_recorded": views,
            "policies": account.snapshots,
            "lag_ms_p50": round(1e3 * percentile(lags, 0.5), 1),
            "lag_ms_p99": round(1e3 * percentile(lags, 0.99), 1),
            "secs_to_catch_up_after_kill": round(caught_up_secs, 2),
            "cpu_share": {name: round(it / took_secs, 2) for name, it in cpu_secs.items()},
        }


def _stop(address: str) -> None:
    """The learner may be in the middle of an update and answer late."""
    deadline_secs = time.monotonic() + 60
    while True:
        try:
            send_control(address, RUN, Command.STOP)
            return
        except OwnerUnreachable:
            assert time.monotonic() < deadline_secs, "the learner does not stop"


def _lags(recording: Path, killed_unix_secs: float) -> tuple[list[float], float]:
    """From commit to writing, of entries outside the outage; and how long that went on.

    The outage are the entries written after the kill, until the lag is under a second again.
    """
    lags: list[float] = []
    was_killed = is_outage = False
    caught_up_unix_secs = killed_unix_secs
    for item in iter_recording(recording):
        if not item.topic.startswith("journal/") or not isinstance(item.decode(), JournalEntry):
            continue
        lag_secs = (item.log_time_ns - item.publish_time_ns) / 1e9
        if not was_killed and item.log_time_ns / 1e9 > killed_unix_secs:
            was_killed = is_outage = True
        if is_outage and lag_secs < 1.0:
            is_outage, caught_up_unix_secs = False, item.log_time_ns / 1e9
        if not is_outage:
            lags.append(lag_secs)
    return lags, caught_up_unix_secs - killed_unix_secs


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--secs", type=float, default=120.0)
    parser.add_argument("--trajectories", type=float, default=100.0, help="a second, journalled")
    parser.add_argument("--views", type=float, default=400.0, help="a second, best effort")
    parser.add_argument("--folder", type=Path, help="for journal and recording; default: /tmp")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--address", help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    arguments = parse_arguments()
    if arguments.address:
        show_views(arguments)
        return
    keep_result(arguments.out, "recording_load", measure(arguments))


if __name__ == "__main__":
    main()
