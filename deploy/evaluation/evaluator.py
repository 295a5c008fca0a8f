"""The live evaluator: scores the policies of a run while it goes on, and delays nobody.

The main thread speaks with the others and keeps the results; a thread of the lowest priority plays.
Each step may be repeated after a crash: an episode is deterministic and counts once its line is in
the file; what is announced follows from the file.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass

from actors.cloth.engine import ClothEngineError
from actors.policy import Policy
from broker_config.bus import Bus
from broker_config.errors import AlreadyOwned, OwnerUnreachable, StorageError
from broker_config.failpoints import Failpoint, reach
from broker_config.heart import Heart, Pulse
from broker_config.joining import StopRequested, attach
from broker_config.keys import ParsedKey
from broker_config.latest import LatestReader
from broker_config.messages import Heartbeat, Snapshot
from broker_config.preset import Preset, preset_from_json
from deploy.evaluation.announcer import Announcer
from deploy.evaluation.player import Player
from deploy.evaluation.policy_shelf import PolicyShelf
from deploy.evaluation.scores import (
    WAITING_FOR_OWNER,
    Episode,
    EpisodeKey,
    Mode,
    Results,
    modes_of,
)
from deploy.priority import Priority, give_way
from deploy.run_folder import RunFolder, prepare_run_folder
from learner.snapshots import SnapshotStore

_log = logging.getLogger(__name__)

POLL_SECS = 0.1
RETRY_SECS = 0.5

TROUBLE_SECS = 5.0
"""Pause after a full disk or a simulator that does not answer."""

SILENCE_SECS = 1.5
"""Three heartbeats: an owner that was not heard of for so long is not there."""

STEP_PATIENCE_SECS = 600.0
"""A step may take so long before the evaluator counts as hung: on a busy machine it starves."""

OWNER_FINISHED = "finished"
"""How the state of an owner that learns no more begins, as its heartbeats say."""


def next_episode(
    versions: Sequence[int],
    modes: Sequence[Mode],
    episodes: int,
    played: Mapping[EpisodeKey, Episode],
) -> EpisodeKey | None:
    """What to play now: whatever is missing of the first version, then of the next.

    Args:
        versions: Most wanted first.
        modes: Likewise.
        episodes: For each version and mode.
        played: What there is.
    """
    for version in versions:
        for mode in modes:
            for number in range(episodes):
                if (version, mode, number) not in played:
                    return version, mode, number
    return None


@dataclass(frozen=True)
class _Tools:
    """What the evaluator works with once it has joined a run."""

    preset: Preset
    modes: tuple[Mode, ...]
    newest: LatestReader[Snapshot]
    shelf: PolicyShelf
    results: Results
    player: Player
    thread: ThreadPoolExecutor
    """The one on which the player plays."""
    announcer: Announcer


class Evaluator:
    """One evaluator process; `run` returns when the run's last policy is scored, or on `stop`.

    Attributes:
        state: What it is doing, as its heartbeats say.
    """

    def __init__(
        self,
        bus: Bus,
        name: str,
        incarnation: str,
        folder: RunFolder,
        episodes: int,
        priority: Priority = "idle",
    ) -> None:
        """Prepares an evaluator.

        Args:
            bus: Its place on the bus, under the same name.
            name: The evaluator's.
            incarnation: Of this process; another for every start.
            folder: Where results, policies and TensorBoard logs go: the run's own folder, or one
                that is made like it.
            episodes: For each version and mode.
            priority: Whether playing gives way to everybody else on the machine.
        """
        self._bus = bus
        self._name = name
        self._incarnation = incarnation
        self._folder = folder
        self._episodes = episodes
        self._prepare_thread = give_way if priority == "idle" else None
        self._stop = threading.Event()
        self._pulse = Pulse()
        self._stepped_secs = 0.0
        self._owner_epoch = 0
        self._owner: Heartbeat | None = None
        self._owner_heard_secs = -math.inf
        self._policy: tuple[int, Policy] | None = None
        self._numbers: dict[str, float] = {"episodes": episodes}
        self.state = "attaching"

    def stop(self) -> None:
        """Asks the evaluator to leave at the next step; safe in a signal handler."""
        self._stop.set()

    def run(self) -> bool:
        """Evaluates.

        Returns:
            Whether the run is over and its last policy scored; False after `stop`.

        Raises:
            AttachRefused: The owner's versions differ.
            StorageError: The folder cannot be used, or is another run's.
        """
        try:
            with self._heart():
                preset = self._join()
                prepare_run_folder(self._folder.path, preset)
                with self._take_results() as results:
                    self._evaluate(preset, results)
        except StopRequested:
            return False
        return True

    def _heart(self) -> Heart:
        return Heart(
            self._bus,
            "evaluator",
            self._name,
            self._incarnation,
            lambda: (self.state, dict(self._numbers)),
            self._pulse,
        )

    # Joining ----------------------------------------------------------------------------------

    def _join(self) -> Preset:
        """The run's preset: from the owner, or from the folder if the run is complete there."""
        while True:
            self._require_going_on()
            try:
                return self._attach(None)
            except OwnerUnreachable as error:
                if (preset := self._complete_run()) is not None:
                    return preset
                _log.debug("%s", error)
                self.state = WAITING_FOR_OWNER
                self._stop.wait(RETRY_SECS)

    def _attach(self, preset: Preset | None) -> Preset:
        welcome = attach(
            self._bus, "evaluator", self._name, self._incarnation, preset, self._stop.wait
        )
        self._owner_epoch = welcome.owner_epoch
        return preset_from_json(welcome.preset_json)

    def _complete_run(self) -> Preset | None:
        """The preset of the folder's run if all of its policies are there and nobody is needed."""
        if not self._folder.preset_file.exists():
            return None
        preset = self._folder.read_preset()
        store = SnapshotStore(self._folder.snapshots)
        is_complete = PolicyShelf(self._bus, store, preset.schedule).is_full
        return preset if is_complete else None

    def _take_results(self) -> Results:
        """The results file, once nobody else evaluates into it."""
        while True:
            self._require_going_on()
            try:
                return Results(self._folder.evaluation)
            except AlreadyOwned as error:
                self._trouble(str(error), RETRY_SECS)

    # The loop ---------------------------------------------------------------------------------

    def _evaluate(self, preset: Preset, results: Results) -> None:
        self._bus.subscribe(self._bus.keys.live("owner", "learner"), Heartbeat, self._on_owner)
        modes = modes_of(preset.algorithm)
        store = SnapshotStore(self._folder.snapshots)
        with (
            closing(Player(preset)) as player,
            Announcer(self._bus, self._name, self._incarnation, self._folder, preset) as announcer,
            ThreadPoolExecutor(1, "player", self._prepare_thread) as thread,
        ):
            tools = _Tools(
                preset,
                modes,
                self._bus.latest_reader(self._bus.keys.policy, Snapshot),
                PolicyShelf(self._bus, store, preset.schedule),
                results,
                player,
                thread,
                announcer,
            )
            announcer.announce_all(results, modes, self._episodes)
            try:
                self._score_until_the_end(tools)
            finally:
                self._stop.set()  # whatever happened: the player's thread shall not play on

    def _score_until_the_end(self, tools: _Tools) -> None:
        while True:
            self._require_going_on()
            self._fetch(tools)
            is_over = self._is_over(tools.shelf)
            versions = tools.shelf.versions()
            wanted = versions[:1] if is_over else versions
            episode = next_episode(wanted, tools.modes, self._episodes, tools.results.episodes)
            if episode is not None:
                self._play(tools, *episode)
            elif is_over:
                self._tell_unscored(tools, versions[1:])
                return
            else:
                self.state = "waiting for a policy" if self._hears_owner() else WAITING_FOR_OWNER
                self._stop.wait(POLL_SECS)

    def _fetch(self, tools: _Tools) -> None:
        """Takes the next policy from the bus, if there is one that is not on the disk."""
        if (newest := tools.newest.get()) is None:
            return
        try:
            if newest.owner_epoch != self._owner_epoch:
                self._attach(tools.preset)
                self._owner_epoch = newest.owner_epoch
            tools.shelf.fetch(newest)
        except OwnerUnreachable as error:
            _log.debug("%s", error)

    def _is_over(self, shelf: PolicyShelf) -> bool:
        """Whether no newer policy comes: the last one is here, or the run was stopped before it."""
        if shelf.is_full:
            return True
        owner = self._owner
        if owner is None or not owner.state.startswith(OWNER_FINISHED):
            return False
        return not shelf.missing(int(owner.numbers.get("policy_version", -1)))

    def _tell_unscored(self, tools: _Tools, versions: Sequence[int]) -> None:
        for mode in tools.modes:
            left = [
                version
                for version in reversed(versions)
                if next_episode([version], [mode], self._episodes, tools.results.episodes)
            ]
            if left:
                _log.info(
                    "Not scored, %s: versions %s; clothbus evaluate %s --mode %s --episodes %d "
                    "--versions %s scores them",
                    mode,
                    ", ".join(map(str, left)),
                    self._folder.path,
                    mode,
                    self._episodes,
                    " ".join(map(str, left)),
                )

    # One episode ------------------------------------------------------------------------------

    def _play(self, tools: _Tools, version: int, mode: Mode, number: int) -> None:
        self.state = f"evaluating version {version}, {mode} {number + 1}/{self._episodes}"
        self._numbers |= {"policy_version": version, "episode": number + 1}
        policy = self._policy_of(tools, version)
        self._on_step()
        playing = tools.thread.submit(
            tools.player.play, policy, version, mode, number, self._on_step
        )
        try:
            episode = self._wait_for(playing, tools)
        except ClothEngineError as error:
            self._trouble(f"simulator: {error}", TROUBLE_SECS)
            return
        reach(Failpoint.EVALUATION_PLAYED)
        self._keep(tools, episode)
        reach(Failpoint.EVALUATION_WRITTEN)
        score = tools.results.score(version, mode, self._episodes, tools.preset.seed)
        if score is not None:
            tools.announcer.announce(score)

    def _wait_for(self, playing: Future[Episode], tools: _Tools) -> Episode:
        """Waits for the player, and meanwhile takes new policies from the bus."""
        while not wait([playing], POLL_SECS).done:
            if time.monotonic() - self._stepped_secs < STEP_PATIENCE_SECS:
                self._pulse.beat()
            self._fetch(tools)
        return playing.result()

    def _keep(self, tools: _Tools, episode: Episode) -> None:
        """Writes an episode down; while the disk is full, waits."""
        while True:
            self._require_going_on()
            try:
                return tools.results.add(episode)
            except StorageError as error:
                self._trouble(str(error), TROUBLE_SECS)

    def _policy_of(self, tools: _Tools, version: int) -> Policy:
        if self._policy is None or self._policy[0] != version:
            weights = tools.shelf.weights(version)
            self._policy = version, Policy.from_bytes(tools.preset.network, weights)
        return self._policy[1]

    # On any thread ----------------------------------------------------------------------------

    def _on_step(self) -> None:
        """The player got on."""
        self._stepped_secs = time.monotonic()
        if self._stop.is_set():
            raise StopRequested

    def _on_owner(self, _: ParsedKey, heartbeat: Heartbeat) -> None:
        self._owner, self._owner_heard_secs = heartbeat, time.monotonic()

    def _hears_owner(self) -> bool:
        return time.monotonic() - self._owner_heard_secs < SILENCE_SECS

    def _require_going_on(self) -> None:
        self._pulse.beat()
        if self._stop.is_set():
            raise StopRequested

    def _trouble(self, what: str, pause_secs: float) -> None:
        """Says once what is wrong, and waits a little."""
        if self.state != what:
            _log.warning("Trying again: %s", what)
        self.state = what
        self._stop.wait(pause_secs)
