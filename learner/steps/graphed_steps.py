"""The gradient steps on a GPU, recorded once and replayed.

A step on 32 small pictures is some fifty short kernels: launched one by one, the GPU waits for
Python. Here a step is recorded as a CUDA graph that takes its minibatch from a table on the device
and advances a cursor there, so that the steps of a whole sub-problem follow each other without the
host. Nothing in it depends on how full the memory is, only on the size of a minibatch.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor

from actors.networks import PreferenceNetwork
from learner.memory import LocalMemory
from learner.steps.eager_steps import preference_loss
from learner.steps.optimiser import FusedAdam, named_state

_TABLE_ROWS = 2048
"""Minibatches that are handed to the device at a time."""
_LONG_GRAPH_STEPS = 16
"""Steps of the long graph; what is left over is replayed step by step."""
_WARM_UP_RUNS = 3
"""Before recording, libraries choose their algorithms and allocate workspaces."""

Program = Callable[[], None]
Record = Callable[[Program], Program]


@contextlib.contextmanager
def exact_float32() -> Iterator[None]:
    """Convolutions in real float32 (not TF32, torch's default), and by repeatable algorithms."""
    with torch.backends.cudnn.flags(
        enabled=True, benchmark=False, deterministic=True, allow_tf32=False
    ):
        yield


def record_cuda_graph(program: Program) -> Program:
    """Records what a program does on the GPU; the result does it again.

    The program is run a few times first, so it must leave no trace that matters.
    """
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call] # torch's own
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(_WARM_UP_RUNS):
            program()
    graph = torch.cuda.CUDAGraph()
    # On the warm-up's stream, since autograd's accumulators belong to a stream.
    with torch.cuda.graph(graph, stream=stream):
        program()
    torch.cuda.current_stream().wait_stream(stream)
    return graph.replay


@dataclass(frozen=True)
class _Table:
    """What the recorded steps read and write, at fixed addresses."""

    cursor: Tensor
    """The row that the next step takes, i64[1]."""
    batches: Tensor
    """i64[_TABLE_ROWS, B]."""
    losses: Tensor
    """f32[_TABLE_ROWS]."""


class GraphedSteps:
    """Makes the steps by replaying graphs; equals `EagerSteps` up to rounding.

    The pictures of the memory that steps see, the network's parameters and the optimiser's state
    must stay where they are.
    """

    def __init__(
        self,
        network: PreferenceNetwork,
        optimiser: FusedAdam,
        memory: LocalMemory,
        record: Record = record_cuda_graph,
    ) -> None:
        """Prepares buffers; graphs are recorded when a minibatch size is first met.

        Args:
            network: On the memory's device.
            optimiser: From `build_optimiser`, for the network.
            memory: Gives pictures and actions.
            record: Turns a program into one that repeats it.
        """
        self._network = network
        self._optimiser = optimiser
        self._memory = memory
        self._record = record
        device = memory.device
        self._positions = torch.zeros(memory.capacity, dtype=torch.int64, device=device)
        self._actions = torch.zeros(memory.capacity, dtype=torch.int64, device=device)
        self._targets = torch.zeros(memory.capacity, dtype=torch.float32, device=device)
        self._recorded: dict[int, tuple[_Table, Program, Program]] = {}

    def run(self, batches: Tensor, targets: Tensor) -> Tensor:
        """See `GradientSteps.run`."""
        n_samples = len(self._memory)
        self._positions[:n_samples] = self._memory.ring_positions
        self._actions[:n_samples] = self._memory.samples.actions
        self._targets[:n_samples] = targets
        batch_size = batches.shape[1]
        if batch_size not in self._recorded:
            self._recorded[batch_size] = self._record_steps(batch_size)
        return torch.cat([self._run_table(rows) for rows in torch.split(batches, _TABLE_ROWS)])

    def _run_table(self, rows: Tensor) -> Tensor:
        table, one_step, many_steps = self._recorded[rows.shape[1]]
        table.batches[: len(rows)] = rows.to(table.batches.device)
        table.cursor.zero_()
        n_long, n_single = divmod(len(rows), _LONG_GRAPH_STEPS)
        for _ in range(n_long):
            many_steps()
        for _ in range(n_single):
            one_step()
        return table.losses[: len(rows)].clone()

    def _record_steps(self, batch_size: int) -> tuple[_Table, Program, Program]:
        device = self._memory.device
        table = _Table(
            torch.zeros(1, dtype=torch.int64, device=device),
            torch.zeros((_TABLE_ROWS, batch_size), dtype=torch.int64, device=device),
            torch.zeros(_TABLE_ROWS, dtype=torch.float32, device=device),
        )

        def one_step() -> None:
            self._step(table)

        def many_steps() -> None:
            for _ in range(_LONG_GRAPH_STEPS):
                self._step(table)

        # The warm-up trains on whatever the table holds: its traces are wiped out.
        trained = [tensor for _, tensor in named_state(self._optimiser, self._network)]
        trained += self._network.parameters()
        before = [tensor.detach().clone() for tensor in trained]
        # A stream belongs to a device, the current one where nothing is said.
        on_device = torch.cuda.device(device) if device.type == "cuda" else nullcontext()
        with on_device, exact_float32():
            programs = self._record(one_step), self._record(many_steps)
        with torch.no_grad():
            for tensor, value in zip(trained, before, strict=True):
                tensor.copy_(value)
        return table, *programs

    def _step(self, table: _Table) -> None:
        batch = table.batches.index_select(0, table.cursor).squeeze(0)
        observations = self._memory.learned_from.index_select(0, self._positions[batch])
        loss = preference_loss(
            self._network, observations, self._actions[batch], self._targets[batch]
        )
        self._optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimiser.step()
        table.losses.index_copy_(0, table.cursor, loss.detach().unsqueeze(0))
        table.cursor.add_(1)
