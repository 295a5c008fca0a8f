"""One `clothbus run` that is disturbed, one fault at a time, each after the last has healed."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from broker_config.bus import open_bus
from broker_config.failpoints import FAILPOINT_VARIABLE, Failpoint
from deploy.process import child_environment
from deploy.run_folder import RunFolder
from tests.faults.cells import AT_START, STOP_SECS, Cell, Fault, Role
from tests.faults.scenes import EVALUATION_EPISODES, Scene
from tests.faults.witness import (
    Child,
    Heartbeats,
    JournalTail,
    children,
    has_ended,
    spooled,
    whole_lines,
)

T = TypeVar("T")

LAST_FAULT_AT = 0.8
"""No fault begins after this share of the episodes: the run shall not end before it has healed."""

START_SECS = 120.0
HEAL_SECS = 180.0
END_SECS = 300.0
LONGEST_PAUSE_SECS = 2.0
_POLL_SECS = 0.02


class NotHealed(Exception):
    """The run did not come back by itself."""


@dataclass(frozen=True)
class Disturbance:
    """A fault that was done to a process. Times are the wall clock's, as those of the journal."""

    cell: Cell
    victim: Child
    incarnation: str
    """Of the victim."""
    ended_unix_secs: float
    """When the fault was over: the kill was sent, the process was let go on."""
    useful_from_unix_secs: float
    """Nothing before counts as an act after the fault: only now is the old process gone."""
    journal_offset: int
    """End of the journal at that time."""
    trajectories: int
    """Likewise."""
    evaluated: int
    """Lines of the evaluation likewise."""


@dataclass(frozen=True)
class Healed:
    """A fault and what came after it."""

    disturbance: Disturbance
    at_secs: float
    """When it began, since the start of the run."""
    recovery_secs: float | None
    """From the end of the fault to the next useful act of its role; None if the run ended first."""


@dataclass
class Outcome:
    """A disturbed run that has ended."""

    folder: RunFolder
    step_log: Path
    wall_secs: float
    healed: list[Healed] = field(default_factory=list)
    spooled_when_killed: list[str] = field(default_factory=list)
    """Trajectories that lay in a spool when its actor was killed."""
    evaluated: set[str] = field(default_factory=set)
    """Lines of the evaluation that were seen at any fault."""
    hangs: int = 0
    """How often the supervisor found a process hanging, and killed it."""


def disturb(
    scene: Scene,
    work: Path,
    seed: int,
    actors: int,
    faults: list[Cell],
    dice: random.Random,
    on_healed: Callable[[Healed], None],
) -> Outcome:
    """Carries out a run and takes faults from the end of the list for as long as it goes on.

    Raises:
        NotHealed: The run did not go on after a fault, or did not end well.
    """
    with _started(scene, work, seed, actors) as run:
        run.wait_steady()
        while faults and run.is_young():
            time.sleep(dice.uniform(0.0, LONGEST_PAUSE_SECS))  # the moment is random
            # By its place: of equal faults, `remove` would take the first and leave this one last.
            ready = [place for place, cell in enumerate(faults) if run.is_ready_for(cell)]
            if ready:
                on_healed(run.do(faults.pop(ready[-1]), dice))
                run.wait_steady()
        return run.finish()


@contextlib.contextmanager
def _started(scene: Scene, work: Path, seed: int, actors: int) -> Iterator[_Run]:
    work.mkdir(parents=True)
    flags = work / "flags"
    flags.mkdir()
    armed = []
    for point in Failpoint:
        (flags / point).touch()  # spent, until a fault takes the flag away
        armed.append(f"{point}:1:{flags / point}")
    options = ["--runs", str(work / "runs"), "--actors", str(actors)]
    options += ["--step-log", str(work / "steps.jsonl")]
    options += ["--evaluate", str(EVALUATION_EPISODES), "--evaluator-priority", "normal"]
    arguments = scene.run_arguments(work.parent, seed, *options)
    with (work / "run.log").open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "deploy.cli", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**child_environment(), FAILPOINT_VARIABLE: ";".join(armed)},
        )
    with contextlib.ExitStack() as stack:
        stack.callback(_end_run, process)
        folder = _wait(lambda: _run_folder(work / "runs"), "a run folder", START_SECS)
        address = _wait(lambda: _address(folder), "the router's address", START_SECS)
        bus = stack.enter_context(open_bus(address, folder.run, "observer", "fault-matrix"))
        tail = stack.enter_context(contextlib.closing(JournalTail(folder.journal)))
        yield _Run(scene, process, folder, work, actors, tail, Heartbeats(bus))


class _Run:
    def __init__(
        self,
        scene: Scene,
        process: subprocess.Popen[bytes],
        folder: RunFolder,
        work: Path,
        actors: int,
        tail: JournalTail,
        heartbeats: Heartbeats,
    ) -> None:
        self._scene = scene
        self._process = process
        self._folder = folder
        self._work = work
        self._processes = actors + len(scene.processes) - 1
        self._tail = tail
        self._heartbeats = heartbeats
        self._began_secs = time.monotonic()
        self._healed: list[Healed] = []
        self._spooled: list[str] = []
        self._evaluated: set[str] = set()

    def is_over(self) -> bool:
        return self._process.poll() is not None

    def is_young(self) -> bool:
        self._tail.poll()
        most = LAST_FAULT_AT * self._scene.episodes
        return not self.is_over() and self._tail.trajectories < most

    def wait_steady(self) -> None:
        """Waits until every process is there and has been heard; the evaluator may be late."""

        def is_steady() -> bool:
            if self.is_over():
                return True
            there = children(self._process.pid).values()
            return len(there) == self._processes and all(
                it.role in (Role.ROUTER, Role.EVALUATOR) or self._heartbeats.of(it.pid)
                for it in there
            )

        self._wait_healed(is_steady, "every process lives and is heard")

    def is_ready_for(self, cell: Cell) -> bool:
        """Whether the process that the fault is for has something to be disturbed in."""
        if self.is_over() or cell.role is not Role.EVALUATOR:
            return not self.is_over()
        there = children(self._process.pid).values()
        evaluator = next((it for it in there if it.role is cell.role), None)
        return evaluator is not None and self._heartbeats.of(evaluator.pid) is not None

    def do(self, cell: Cell, dice: random.Random) -> Healed:
        """Does one thing to one process and waits until its role has done something useful."""
        there = children(self._process.pid)
        chosen = dice.choice([it for it in there.values() if it.role is cell.role])
        at_secs = round(time.monotonic() - self._began_secs, 3)
        if cell.failpoint is not None:
            disturbance = self._kill_at(cell, cell.failpoint, chosen, there)
        elif cell.fault is Fault.STOP:
            disturbance = self._stop(cell, chosen)
        else:
            disturbance = self._end(cell, chosen)
        seen = self._wait_healed(
            lambda: self._useful_act(disturbance) or self.is_over(), f"{cell.role} {cell.name}"
        )
        is_healed = not isinstance(seen, bool)
        recovery_secs = round(seen - disturbance.ended_unix_secs, 3) if is_healed else None
        healed = Healed(disturbance, at_secs, recovery_secs)
        self._healed.append(healed)
        return healed

    def finish(self) -> Outcome:
        """Waits for the end of the run."""
        try:
            code = self._process.wait(END_SECS)
        except subprocess.TimeoutExpired:
            raise NotHealed(self._failure(f"it still runs after {END_SECS:g} s")) from None
        if code != 0:
            raise NotHealed(self._failure(f"it ended with code {code}"))
        return Outcome(
            self._folder,
            self._work / "steps.jsonl",
            time.monotonic() - self._began_secs,
            self._healed,
            self._spooled,
            self._evaluated,
            (self._work / "run.log").read_text(errors="replace").count(" hangs: "),
        )

    # Faults -----------------------------------------------------------------------------------

    def _stop(self, cell: Cell, victim: Child) -> Disturbance:
        os.kill(victim.pid, signal.SIGSTOP)
        time.sleep(STOP_SECS)  # this is the fault
        done = self._done(cell, victim, time.time())
        os.kill(victim.pid, signal.SIGCONT)
        return done

    def _end(self, cell: Cell, victim: Child) -> Disturbance:
        if cell.fault is Fault.KILL and cell.role is Role.ACTOR:
            os.kill(victim.pid, signal.SIGSTOP)  # nothing happens between the look and the kill
            self._spooled += spooled(self._folder.spool(victim.id))
        ended_unix_secs = time.time()
        os.kill(victim.pid, signal.SIGKILL if cell.fault is Fault.KILL else signal.SIGTERM)
        return self._gone(cell, victim, ended_unix_secs)

    def _kill_at(
        self, cell: Cell, point: Failpoint, chosen: Child, there: dict[str, Child]
    ) -> Disturbance:
        """Has whoever of the role is the first at a failpoint die there."""
        flag = self._work / "flags" / point
        flag.unlink()
        if point in AT_START:
            os.kill(chosen.pid, signal.SIGKILL)
            candidates = [self._successor(chosen)]
        else:
            candidates = [it for it in there.values() if it.role is chosen.role]
        self._wait_healed(flag.exists, f"somebody at failpoint {point}")
        victim = self._wait_healed(
            lambda: next((it for it in candidates if has_ended(it.pid)), None), f"death at {point}"
        )
        return self._gone(cell, victim, flag.stat().st_mtime)

    def _gone(self, cell: Cell, victim: Child, ended_unix_secs: float) -> Disturbance:
        self._wait_healed(lambda: has_ended(victim.pid), f"{victim.id} is gone")
        return self._done(cell, victim, ended_unix_secs)

    def _done(self, cell: Cell, victim: Child, ended_unix_secs: float) -> Disturbance:
        heard = self._heartbeats.of(victim.pid)
        lines = whole_lines(self._folder.evaluation)
        self._evaluated.update(lines)
        self._tail.poll()
        return Disturbance(
            cell,
            victim,
            heard.heartbeat.incarnation if heard else "",
            ended_unix_secs,
            time.time(),
            len(self._tail.entries),
            self._tail.trajectories,
            len(lines),
        )

    def _successor(self, dead: Child) -> Child:
        def look() -> Child | None:
            found = children(self._process.pid).get(dead.id)
            return found if found is not None and found.pid != dead.pid else None

        return self._wait_healed(look, f"a new {dead.id}")

    # Healing ----------------------------------------------------------------------------------

    def _useful_act(self, it: Disturbance) -> float | None:
        """When the role has done its work again; None if not yet."""
        self._tail.poll()
        since_secs = it.useful_from_unix_secs
        match it.cell.role:
            case Role.ACTOR:
                old = None if it.cell.fault is Fault.STOP else it.incarnation
                return self._committed((f"trajectory/{it.victim.id}/",), since_secs, old)
            case Role.LEARNER:
                return self._committed(("ticket/", "trajectory/"), since_secs)
            case Role.ROUTER:
                return self._committed(("trajectory/",), since_secs)
            case Role.RECORDER:
                return self._caught_up(it)
            case Role.DISCRIMINATOR:
                return self._committed(("rewards/",), since_secs)
            case Role.EVALUATOR:
                has_more = len(whole_lines(self._folder.evaluation)) > it.evaluated
                return time.time() if has_more else None

    def _committed(
        self, prefixes: tuple[str, ...], since_secs: float, not_of: str | None = None
    ) -> float | None:
        entry = self._tail.first(prefixes, since_secs, not_of)
        return entry.unix_secs if entry else None

    def _caught_up(self, it: Disturbance) -> float | None:
        child = None if self.is_over() else children(self._process.pid).get(it.victim.id)
        heard = self._heartbeats.of(child.pid) if child else None
        if heard is None or heard.unix_secs < it.useful_from_unix_secs:
            return None
        numbers = heard.heartbeat.numbers
        has_all = numbers["next_offset"] >= it.journal_offset and numbers["behind"] == 0
        return heard.unix_secs if has_all else None

    def _wait_healed(self, look: Callable[[], T | None], what: str) -> T:
        deadline_secs = time.monotonic() + HEAL_SECS
        while not (seen := look()):
            if time.monotonic() > deadline_secs or (self.is_over() and self._process.returncode):
                raise NotHealed(self._failure(f"waited {HEAL_SECS:g} s for: {what}"))
            time.sleep(_POLL_SECS)
        return seen

    def _failure(self, what: str) -> str:
        log = (self._work / "run.log").read_text(errors="replace")
        return f"{what}; see {self._work}; its supervisor's last words:\n{log[-2000:]}"


def _wait(look: Callable[[], T | None], what: str, timeout_secs: float) -> T:
    deadline_secs = time.monotonic() + timeout_secs
    while (seen := look()) is None:
        if time.monotonic() > deadline_secs:
            raise NotHealed(f"waited {timeout_secs:g} s for {what}")
        time.sleep(_POLL_SECS)
    return seen


def _run_folder(runs: Path) -> RunFolder | None:
    folders = [it for it in runs.glob("*") if (it / "preset.json").exists()]
    return RunFolder(folders[0]) if folders else None


def _address(folder: RunFolder) -> str | None:
    file = folder.router_address
    return file.read_text().strip() if file.exists() else None


def _end_run(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
