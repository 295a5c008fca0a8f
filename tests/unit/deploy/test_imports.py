"""What processes import: torch and a simulator cost every start seconds."""

from __future__ import annotations

import subprocess
import sys

HEAVY = {"torch", "gymnasium", "pybullet", "numba", "cv2", "matplotlib", "tensorboard"}

NEITHER_LEARNS_NOR_ACTS = """
import deploy.cli, deploy.recorder, deploy.roles, deploy.run, deploy.status
"""

LEARNS_AND_REACHES = """
import numpy as np
import deploy.roles, learner.metrics, learner.service, actors.service
from actors.task import make_task_env
from deploy.presets import load_preset
from learner.trainer import Trainer
preset = load_preset("reaching-smoke")
env, trainer = make_task_env(preset.task), Trainer(preset)
observations = np.stack([env.reset(seed=0)[0], env.step(0)[0]])
trainer.add(observations, np.zeros(1, np.int32), np.zeros(1, np.float32), terminated=False)
trainer.update(1)
"""


def imported(program: str) -> set[str]:
    """The modules that a program has imported in the end."""
    command = [sys.executable, "-c", f"{program}\nimport sys; print(*sys.modules)"]
    return set(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split())


def test_commands_that_neither_learn_nor_act_import_neither_torch_nor_a_simulator() -> None:
    assert not imported(NEITHER_LEARNS_NOR_ACTS) & HEAVY


def test_learning_and_reaching_import_no_compiler_no_cloth_and_nothing_that_draws() -> None:
    modules = imported(LEARNS_AND_REACHES)
    assert {"torch", "gymnasium"} <= modules
    assert not modules & {"torch._dynamo", "sympy", "numba", "pybullet", "matplotlib"}
