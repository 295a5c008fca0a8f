"""What a disturbed run owes: steps acted, journalled, recorded and evaluated, to be compared."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from broker_config.failpoints import Failpoint
from broker_config.journal import JournalReader
from deploy.evaluation.scores import modes_of, read_results
from deploy.process import child_environment
from deploy.run_folder import RunFolder
from tests.faults.cells import Fault, Role
from tests.faults.disturbed_run import Healed, Outcome
from tests.faults.scenes import EVALUATION_EPISODES, Scene
from tests.faults.witness import whole_lines
from tests.process.accounting import Episode, Match, match_episodes
from tests.process.recorded import settle_recording

_UNDISTURBED = """
from deploy.priority import give_way
give_way()
from deploy.cli import main
main()
"""

BEFORE_THE_SPOOL = frozenset({Failpoint.TICKET_RECEIVED, Failpoint.EPISODE_PLAYED})
"""An actor that dies here has spooled nothing of the episode."""


@dataclass(frozen=True)
class Ledger:
    """Counts of one run; `lost`, `double` and what is like them must be 0."""

    acted_steps: int
    """By the log on the environments' side."""
    journalled_steps: int
    cut_off_steps: int
    """Of episodes that died with their process before they were spooled; played again."""
    lost_steps: int
    """Of spooled or finished episodes that are not in the journal."""
    lost_spooled: int
    """Trajectories that lay in a spool when its actor was killed, and are not in the journal."""
    double_trajectories: int
    """Journalled without an episode of their own."""
    journal_entries: int
    recorded_entries: int
    recorded_snapshots: int
    evaluated_lines: int
    lost_lines: int
    """Of the evaluation: seen once and gone, or missing for the last version."""
    double_lines: int
    weights: str
    """Digest of the final policy."""
    undisturbed_weights: str

    @property
    def is_settled(self) -> bool:
        """Whether nothing is lost or double, and the policy is the undisturbed one's."""
        wrong = (
            self.lost_steps,
            self.lost_spooled,
            self.double_trajectories,
            self.lost_lines,
            self.double_lines,
            self.journal_entries - self.recorded_entries,
        )
        return not any(wrong) and self.weights == self.undisturbed_weights


def settle_run(outcome: Outcome, undisturbed: RunFolder) -> Ledger:
    """Compares what happened with what is kept.

    Raises:
        AssertionError: The recording is not the journal.
    """
    folder = outcome.folder
    with JournalReader(folder.journal) as journal:
        match = match_episodes(outcome.step_log, journal)
        entries = journal.end_offset
        kept = {it.name.removeprefix("trajectory/") for it in journal.entries("trajectory/")}
    lost_steps = _lost_steps(match, outcome.healed)
    recorded = settle_recording(folder.recording, folder.journal)
    lost_lines, double_lines = _evaluation(folder, outcome.evaluated)
    return Ledger(
        acted_steps=sum(map(len, match.played.values())),
        journalled_steps=match.journalled,
        cut_off_steps=match.missing.total() - lost_steps,
        lost_steps=lost_steps,
        lost_spooled=len(set(outcome.spooled_when_killed) - kept),
        double_trajectories=len(match.strangers),
        journal_entries=entries,
        recorded_entries=recorded.entries,
        recorded_snapshots=recorded.snapshots,
        evaluated_lines=len(whole_lines(folder.evaluation)),
        lost_lines=lost_lines,
        double_lines=double_lines,
        weights=weights_digest(folder),
        undisturbed_weights=weights_digest(undisturbed),
    )


def _lost_steps(match: Match, healed: list[Healed]) -> int:
    """Steps that are missing although their process did not die while it had only them."""
    killed: set[str] = set()
    for it in healed:
        cell = it.disturbance.cell
        is_kill = cell.role is Role.ACTOR and cell.fault is Fault.KILL
        if is_kill and (cell.failpoint is None or cell.failpoint in BEFORE_THE_SPOOL):
            killed.add(it.disturbance.incarnation)
    last: Counter[str] = Counter()
    for incarnation, number in match.played:
        last[incarnation] = max(last[incarnation], number)
    horizon = max(map(len, match.played.values()))

    def is_cut_off(episode: Episode) -> bool:
        incarnation, number = episode
        is_whole = len(match.played[episode]) == horizon
        return number == last[incarnation] and (not is_whole or incarnation in killed)

    return sum(steps for it, steps in match.missing.items() if not is_cut_off(it))


def _evaluation(folder: RunFolder, seen: set[str]) -> tuple[int, int]:
    preset = folder.read_preset()
    keys = Counter(it.key for it in read_results(folder.evaluation))
    newest = preset.schedule.iteration_versions()[-1]
    wanted = {
        (newest, mode, number)
        for mode in modes_of(preset.algorithm)
        for number in range(EVALUATION_EPISODES)
    }
    lost = len(seen - set(whole_lines(folder.evaluation))) + len(wanted - keys.keys())
    return lost, keys.total() - len(keys)


def weights_digest(folder: RunFolder) -> str:
    """Of a run's newest policy."""
    return sha256(max(folder.snapshots.glob("*.safetensors")).read_bytes()).hexdigest()


class Undisturbed:
    """The same run in one process, at the lowest priority beside the disturbed one."""

    def __init__(self, scene: Scene, work: Path, seed: int) -> None:
        self._runs = work / "undisturbed"
        self._log = work / "undisturbed.log"
        arguments = scene.run_arguments(work, seed, "--in-process", "--runs", str(self._runs))
        command = [sys.executable, "-c", _UNDISTURBED, *arguments]
        work.mkdir(parents=True, exist_ok=True)
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=dict(child_environment()),
                start_new_session=True,  # priorities hold among sessions, where the kernel has it
            )

    def wait(self, timeout_secs: float) -> RunFolder:
        """Returns its folder.

        Raises:
            RuntimeError: It failed.
        """
        if self._process.wait(timeout_secs) != 0:
            raise RuntimeError(f"the undisturbed run failed: {self._log.read_text()[-2000:]}")
        (folder,) = self._runs.iterdir()
        return RunFolder(folder)

    def close(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
