"""Gradient steps a second of each training path, beside the loop as written and stable-baselines3.

    python -m tests.benchmarks.gradient_steps --rounds 3
    python -m tests.benchmarks.gradient_steps --rounds 3 --device cuda

All train the plain network on 84x84 pictures of the 5-joint arm with a memory of 450 samples, on
one core. Each candidate of each round is a process of its own, so that its memory is its own too;
candidates take turns. Ours are whole updates of one target switch and 20 epochs, teaching signals
and all. Beside them stands what the machine multiplies at best: the ceiling.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor, nn

from broker_config.preset import Preset
from deploy.presets import load_preset
from learner.steps.compute import Compute, TrainingPath
from learner.trainer import Trainer
from tests.benchmarks.measuring import RESULTS, keep_result

AS_WRITTEN, SB3 = "Algorithm 1 as written", "stable-baselines3 DQN.train"
BATCHES = (32, 128)
N_SAMPLES, N_ACTIONS, PICTURE = 450, 25, (84, 84, 1)
GFLOP_PER_SAMPLE = 1.271 / 32
"""Of a step's products: forwards, weights' gradients, and inputs' gradients but for the first."""
OPTIONS = ("schedule.epochs=20", "schedule.target_switches=1", "optimiser.name=adam")
MATRIX = 1024

Run = Callable[[], int]
"""Trains for some seconds; returns how many gradient steps it made."""


def ours(path: TrainingPath, batch: int, device: str) -> Run:
    """An update of a full memory."""
    options = (*OPTIONS, f"schedule.minibatch_size={batch}", "optimiser.epsilon=1e-8")
    preset: Preset = load_preset("reaching-ch3", options)
    trainer = Trainer(preset, Compute(device, path))
    generator = np.random.default_rng(0)
    for _ in range(15):
        trainer.add(
            generator.integers(0, 256, (31, *PICTURE), np.uint8),
            generator.integers(0, N_ACTIONS, 30).astype(np.int32),
            generator.normal(size=30).astype(np.float32),
            terminated=False,
        )
    return lambda: trainer.update().gradient_steps


def as_written(batch: int, device: str) -> Run:
    """Teaching signals in each minibatch from a second network; plain convolutions and Adam."""
    online, target = (_plain_network().to(device) for _ in range(2))
    optimiser = torch.optim.Adam(online.parameters(), 2.5e-4)
    states = torch.randint(0, 256, (N_SAMPLES, 1, 84, 84), dtype=torch.uint8, device=device)
    next_states = torch.randint(0, 256, (N_SAMPLES, 1, 84, 84), dtype=torch.uint8, device=device)
    actions = torch.randint(0, N_ACTIONS, (N_SAMPLES,), device=device)
    rewards = torch.randn(N_SAMPLES, device=device)

    def one_step() -> None:
        picked = torch.randint(0, N_SAMPLES, (batch,), device=device)
        with torch.no_grad():
            now = target(states[picked].float() / 255)
            later = target(next_states[picked].float() / 255)
            chosen = now.gather(1, actions[picked, None])[:, 0]
            signal = chosen - now.logsumexp(1) + rewards[picked] + 0.95 * later.logsumexp(1)
        outputs = online(states[picked].float() / 255)
        loss = nn.functional.mse_loss(outputs.gather(1, actions[picked, None])[:, 0], signal)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()

    return lambda: _repeat(one_step, 1280 // batch)


def _plain_network() -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(1, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU(),
        nn.Conv2d(64, 64, 3, 1), nn.ReLU(), nn.Flatten(),
        nn.Linear(3136, 512), nn.ReLU(), nn.Linear(512, N_ACTIONS),
    )  # fmt: skip


def _repeat(step: Callable[[], None], times: int) -> int:
    for _ in range(times):
        step()
    return times


def by_stable_baselines3(batch: int, device: str) -> Run:
    """Its DQN's `train` on a full buffer of the same pictures."""
    import gymnasium
    from stable_baselines3 import DQN
    from stable_baselines3.common.logger import configure

    class Pictures(gymnasium.Env[Any, Any]):
        observation_space = gymnasium.spaces.Box(0, 255, PICTURE, np.uint8)
        action_space = gymnasium.spaces.Discrete(N_ACTIONS)

    model = DQN("CnnPolicy", Pictures(), buffer_size=N_SAMPLES, batch_size=batch, device=device)
    model.set_logger(configure(None, []))
    generator = np.random.default_rng(0)
    for _ in range(N_SAMPLES):
        pictures = generator.integers(0, 256, (2, 1, 1, 84, 84), np.uint8)
        action = generator.integers(0, N_ACTIONS, (1, 1))
        done, reward = np.zeros(1), generator.normal(size=1)
        model.replay_buffer.add(pictures[0], pictures[1], action, reward, done, [{}])

    def run() -> int:
        model.train(1280 // batch, batch)
        return 1280 // batch

    return run


def make(candidate: str, batch: int, device: str) -> Run:
    """A candidate by its name."""
    if candidate == AS_WRITTEN:
        return as_written(batch, device)
    if candidate == SB3:
        return by_stable_baselines3(batch, device)
    return ours(candidate, batch, device)  # type: ignore[arg-type] # one of the paths


def measure(candidate: str, batch: int, device: str) -> dict[str, float]:
    """Steps a second (processor time; on a GPU wall time), and the most memory."""
    torch.set_num_threads(1)
    run = make(candidate, batch, device)
    run()  # compiles, records, allocates
    began_secs, steps = _now_secs(device), run()
    secs = _now_secs(device) - began_secs
    mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if device != "cpu":
        mib = torch.cuda.max_memory_allocated() / 2**20
    return {"steps_per_sec": round(steps / secs, 2), "peak_mib": round(mib, 1)}


def _now_secs(device: str) -> float:
    if device == "cpu":
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()


def peak_gflop_per_sec(dtype: torch.dtype, device: str) -> float:
    """What a product of square matrices of 1,024 rows reaches, the best of five."""
    torch.set_num_threads(1)
    a, b = (torch.randn(MATRIX, MATRIX, device=device).to(dtype) for _ in range(2))
    out: Tensor = a @ b
    best_secs = float("inf")
    for _ in range(5):
        began_secs = _now_secs(device)
        torch.mm(a, b, out=out)
        best_secs = min(best_secs, _now_secs(device) - began_secs)
    return round(2 * MATRIX**3 / best_secs / 1e9, 1)


def candidates(device: str, peaks: dict[str, float]) -> list[str]:
    """All that can run here at a reasonable pace."""
    names = [AS_WRITTEN, SB3]
    for path in get_args(TrainingPath):
        on_cuda, is_graphs = device != "cpu", path == "graphs"
        if on_cuda != is_graphs and path != "reference":
            continue
        if path == "winograd-bf16" and peaks["bfloat16"] < peaks["float32"]:
            print("winograd-bf16: left out, this processor has no products of bfloat16")
            continue
        names.append(path)
    return names


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--candidate", help="measure this one here, and print JSON")
    parser.add_argument("--batch", type=int, default=BATCHES[0])
    given = parser.parse_args()
    if given.candidate:
        print(json.dumps(measure(given.candidate, given.batch, given.device)))
        return
    peaks = {
        str(dtype).removeprefix("torch."): peak_gflop_per_sec(dtype, given.device)
        for dtype in (torch.float32, torch.bfloat16)
    }
    found: dict[str, dict[str, list[dict[str, float]]]] = {}
    for number in range(given.rounds):
        for batch in BATCHES:
            for candidate in candidates(given.device, peaks):
                result = _measure_apart(candidate, batch, given.device)
                found.setdefault(str(batch), {}).setdefault(candidate, []).append(result)
                print(f"round {number}, minibatch {batch}: {candidate}: {result}", flush=True)
    keep_result(
        given.out,
        "gradient_steps",
        {
            "device": given.device,
            "processor": _processor(given.device),
            "peak_gflop_per_sec": peaks,
            "gflop_per_sample": GFLOP_PER_SAMPLE,
            "found": found,
        },
    )


def _measure_apart(candidate: str, batch: int, device: str) -> dict[str, float]:
    module = "tests.benchmarks.gradient_steps"
    told = ("--candidate", candidate, "--batch", str(batch), "--device", device)
    done = subprocess.run(
        [sys.executable, "-m", module, *told], capture_output=True, text=True, check=False
    )
    if "No module named 'stable_baselines3'" in done.stderr:
        return {}
    assert done.returncode == 0, done.stderr
    result: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return result


def _processor(device: str) -> str:
    if device != "cpu":
        return torch.cuda.get_device_name()
    models = [
        line.partition(":")[2].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    return f"{models[0]}, {torch.backends.cpu.get_cpu_capability()}"


if __name__ == "__main__":
    main()
