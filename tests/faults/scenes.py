"""Which run is disturbed, and in which of its processes: the two scenes of the fault matrix."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tests.faults.cells import FAILPOINT_CELLS, Cell, Fault, Role

EVALUATION_EPISODES = 2
_FIVE_DOF = ("task.options.n_joints=5", "task.n_actions=25", "task.horizon=25")


@dataclass(frozen=True)
class Scene:
    """A run of 5-DOF reaching: an iteration is an episode of each of four actors, and an update."""

    name: str
    title: str
    preset: str
    iterations: int
    settings: tuple[str, ...]
    processes: tuple[Role, ...]
    """That the run has."""
    disturbed: tuple[Role, ...]
    """Those of them that faults are done to."""
    demonstrations: int = 0
    """Episodes that are demonstrated before."""
    episodes_per_iteration: int = 4

    @property
    def episodes(self) -> int:
        """Of a whole run."""
        return self.iterations * self.episodes_per_iteration

    @property
    def all_settings(self) -> tuple[str, ...]:
        """Whatever the run changes of its preset."""
        return (
            *_FIVE_DOF,
            f"schedule.iterations={self.iterations}",
            f"schedule.episodes_per_iteration={self.episodes_per_iteration}",
            *self.settings,
        )

    @property
    def random_cells(self) -> tuple[Cell, ...]:
        """Faults at random moments."""
        return tuple(Cell(role, fault) for role in self.disturbed for fault in Fault)

    @property
    def failpoint_cells(self) -> tuple[Cell, ...]:
        """Kills at the failpoints that this run reaches."""
        imitates = Role.DISCRIMINATOR in self.processes
        return tuple(
            cell
            for cell in FAILPOINT_CELLS
            if cell.role in self.disturbed and (imitates or not cell.is_of_imitation)
        )

    def prepare(self, work: Path) -> None:
        """Makes what runs in this folder need: the demonstrations."""
        folder = work / "demonstrations"
        if self.demonstrations and not folder.exists():
            arguments = ["demos", "make", self.preset, "--output", str(folder)]
            arguments += ["--episodes", str(self.demonstrations), "--set", *_FIVE_DOF]
            subprocess.run([sys.executable, "-m", "deploy.cli", *arguments], check=True)

    def run_arguments(self, work: Path, seed: int, *options: str) -> list[str]:
        """`clothbus run` of it; an undisturbed one with the same seed ends with the same weights.

        Args:
            work: Folder that `prepare` has seen.
            seed: Of the run.
            options: Of `clothbus run`.
        """
        given = ["--demonstrations", str(work / "demonstrations")] if self.demonstrations else []
        settings = ["--set", *self.all_settings, f"seed={seed}"]
        return ["run", self.preset, *options, *given, *settings]


_EVERY_RUN = (Role.ACTOR, Role.LEARNER, Role.RECORDER, Role.ROUTER, Role.EVALUATOR)

LEARNING = Scene(
    name="learning",
    title="Fault matrix",
    preset="reaching-smoke",
    iterations=100,
    settings=(
        'schedule.update_every="iteration"',
        "schedule.memory_samples=100",
        "schedule.target_switches=1",
        "schedule.epochs=1",
    ),
    processes=_EVERY_RUN,
    disturbed=_EVERY_RUN,
)
IMITATION = Scene(
    name="imitation",
    title="Fault matrix of imitation",
    preset="imitation-smoke",
    iterations=60,
    settings=("schedule.memory_samples=250", "imitation.target_reward=-1.2"),
    processes=(*_EVERY_RUN, Role.DISCRIMINATOR),
    disturbed=(Role.DISCRIMINATOR, Role.LEARNER, Role.ROUTER),
    demonstrations=3,
)
SCENES = {scene.name: scene for scene in (LEARNING, IMITATION)}
