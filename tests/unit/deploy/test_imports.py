"""What processes import: torch and a simulator cost every start seconds."""

from __future__ import annotations

import subprocess
import sys

HEAVY = {"torch", "gymnasium", "pybullet", "numba", "cv2", "matplotlib", "tensorboard"}

NEITHER_LEARNS_NOR_ACTS = """
import deploy.cli, deploy.commands.status, deploy.recorder.recorder
import deploy.running.roles, deploy.running.run
"""

REACHES = """
import actors.service, deploy.running.roles
from actors.task import make_task_env
from deploy.presets import load_preset
preset = load_preset("reaching-smoke")
env = make_task_env(preset.task)
env.reset(seed=0)
env.step(0)
"""

LEARNS = """
import numpy as np
import deploy.running.roles, learner.metrics, learner.service
from deploy.presets import load_preset
from learner.trainer import Trainer
preset = load_preset("reaching-smoke")
trainer = Trainer(preset)
observations = np.zeros((2, *preset.task.observation_shape), np.uint8)
trainer.add(observations, np.zeros(1, np.int32), np.zeros(1, np.float32), terminated=False)
trainer.update(1)
"""

SLOW_FOR_ALL = {"torch._dynamo", "sympy", "pybullet", "matplotlib"}
"""The first two are torch's own compiler, which takes seconds."""


def imported(program: str) -> set[str]:
    """The modules that a program has imported in the end."""
    command = [sys.executable, "-c", f"{program}\nimport sys; print(*sys.modules)"]
    return set(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split())


def test_commands_that_neither_learn_nor_act_import_neither_torch_nor_a_simulator() -> None:
    assert not imported(NEITHER_LEARNS_NOR_ACTS) & HEAVY


def test_reaching_imports_no_compiler_no_cloth_and_nothing_that_draws() -> None:
    modules = imported(REACHES)
    assert {"torch", "gymnasium"} <= modules
    assert not modules & {*SLOW_FOR_ALL, "numba"}


def test_learning_imports_numba_alone_of_the_compilers() -> None:
    modules = imported(LEARNS)
    assert {"torch", "numba"} <= modules
    assert not modules & SLOW_FOR_ALL


def test_who_makes_no_steps_waits_for_no_compiler() -> None:
    assert not imported("import learner.trainer") & {*SLOW_FOR_ALL, "numba"}
