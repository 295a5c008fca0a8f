"""Makes the scores of evaluated policies known: on the bus, and as TensorBoard scalars."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence

from torch.utils.tensorboard.writer import SummaryWriter

from broker_config.bus import Bus
from broker_config.messages import Metrics
from broker_config.preset import Preset
from deploy.evaluation.scores import Mode, Results, Score
from deploy.run_folder import RunFolder

_log = logging.getLogger(__name__)


class Announcer:
    """Makes complete scores known: on the bus, and as TensorBoard scalars.

    All of it follows from the results file, so that it is made anew with each process: whatever a
    crash has swallowed is there again.
    """

    def __init__(
        self, bus: Bus, name: str, incarnation: str, folder: RunFolder, preset: Preset
    ) -> None:
        self._publisher = bus.publisher(bus.keys.metrics("evaluator", name))
        self._name = name
        self._incarnation = incarnation
        self._sequence = 0
        self._schedule = preset.schedule
        self._seed = preset.seed
        shutil.rmtree(folder.evaluation_tensorboard, ignore_errors=True)
        self._writer = SummaryWriter(str(folder.evaluation_tensorboard))

    def __enter__(self) -> Announcer:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def announce_all(self, results: Results, modes: Sequence[Mode], episodes: int) -> None:
        """Announces every complete score that the file holds, the newest last."""
        for version in self._schedule.iteration_versions():
            for mode in modes:
                score = results.score(version, mode, episodes, self._seed)
                if score is not None:
                    self.announce(score)

    def announce(self, score: Score) -> None:
        """Announces a score."""
        step = self._schedule.episodes_before(score.version)
        numbers = {"version": float(score.version), **score.numbers}
        _log.info(
            "Version %d, %s: return %.3f (%.3f to %.3f), success %.0f %% (%.0f to %.0f %%)",
            score.version,
            score.mode,
            score.mean_return,
            *score.return_interval,
            100 * score.success_rate,
            *(100 * bound for bound in score.success_interval),
        )
        for name, number in score.numbers.items():
            self._writer.add_scalar(name, number, step)
        self._writer.flush()
        self._publisher.put(
            Metrics("evaluator", self._name, self._incarnation, self._sequence, step, numbers)
        )
        self._sequence += 1
