"""Live progress of a run: a table on a terminal, one line for each iteration elsewhere."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping, Sequence

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from broker_config.keys import ParsedKey
from broker_config.messages import Metrics
from broker_config.preset import Preset
from deploy.running.launch import Supervised

REFRESH_PER_SEC = 4

TELL_SECS = 30.0
"""Between two lines about a wait, where there is no terminal."""


class Progress:
    """Shows the learner's newest numbers and what the processes do; feed it from any thread."""

    def __init__(self, preset: Preset, console: Console) -> None:
        self._schedule = preset.schedule
        self._title = preset.name
        self._console = console
        self._lock = threading.Lock()
        self._numbers: dict[str, float] = {}
        self._episodes: dict[int, tuple[float, float]] = {}
        self._printed = 0
        self._waits_for = ""
        self._told_secs = -math.inf
        self._began_secs = time.monotonic()
        self._live = Live(
            console=console, refresh_per_second=REFRESH_PER_SEC, transient=True, auto_refresh=False
        )

    def __enter__(self) -> Progress:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def on_metrics(self, _: ParsedKey, metrics: Metrics) -> None:
        """Takes the learner's numbers from the bus."""
        self.update(metrics.numbers)

    def update(self, numbers: Mapping[str, float]) -> None:
        """Takes new numbers; ones that are missing keep their last value."""
        with self._lock:
            self._numbers.update(numbers)
            if "episode" in self._numbers and "return" in self._numbers:
                index = int(self._numbers["episode"]) - 1
                self._episodes[index] = self._numbers["return"], self._numbers.get("success", 0.0)

    def show(self, processes: Sequence[Supervised] = ()) -> None:
        """Draws the current state; call it several times a second."""
        if self._console.is_terminal:
            self._live.update(self._draw(processes), refresh=True)
        else:
            self._print_finished_iterations()

    def wait_for(self, process: str, state: str, processes: Sequence[Supervised] = ()) -> None:
        """Says for whom a run that is over still waits; call it several times a second."""
        self._waits_for = f"{process}: {state} (Ctrl-C does not wait)"
        now_secs = time.monotonic()
        if self._console.is_terminal:
            self.show(processes)
        elif now_secs - self._told_secs > TELL_SECS:
            self._told_secs = now_secs
            self._console.print(f"waiting for {self._waits_for}", highlight=False, soft_wrap=True)

    def _draw(self, processes: Sequence[Supervised]) -> RenderableType:
        with self._lock:
            numbers = dict(self._numbers)
            recent = self._recent_episodes(int(numbers.get("iteration", 1)) - 1)
        episode, episodes = numbers.get("episode", 0), self._schedule.episodes
        table = Table(title=self._title, show_header=False, box=None, title_justify="left")
        minutes = (time.monotonic() - self._began_secs) / 60
        iteration = numbers.get("iteration", 0)
        table.add_row("iteration", f"{iteration:.0f} of {self._schedule.iterations}")
        table.add_row("episode", f"{episode:.0f} of {episodes}, {minutes:.1f} min")
        table.add_row("return", _mean_and_last([value for value, _ in recent]))
        table.add_row("success", _percentage([value for _, value in recent]))
        table.add_row("transitions/s", f"{numbers.get('transitions_per_sec', 0):.1f}")
        table.add_row("policy version", f"{numbers.get('policy_version', 0):.0f}")
        table.add_row("policy lag", f"{numbers.get('policy_lag', 0):.0f}")
        table.add_row("loss", f"{numbers['loss']:.4g}" if "loss" in numbers else "-")
        if wrong := numbers.get("invalid", 0) + numbers.get("lost", 0):
            table.add_row("attempts gone wrong", f"{wrong:.0f} (see the learner's log)")
        if numbers.get("paused"):
            table.add_row("state", "paused: clothbus control resume")
        if self._waits_for:
            table.add_row("waiting for", self._waits_for)
        restarted = [f"{p.spec.id} x{p.restarts}" for p in processes if p.restarts]
        if restarted:
            table.add_row("restarted", ", ".join(restarted))
        return Group(table, ProgressBar(total=episodes, completed=int(episode), width=60))

    def _recent_episodes(self, iteration: int) -> list[tuple[float, float]]:
        """Of the iteration; the one before counts until there is a first episode."""
        per_iteration = self._schedule.episodes_per_iteration
        start = max(0, iteration) * per_iteration
        indices = range(start, start + per_iteration)
        return [self._episodes[index] for index in indices if index in self._episodes]

    def _print_finished_iterations(self) -> None:
        """Prints each iteration once, when it has been learned from."""
        per_iteration = self._schedule.episodes_per_iteration
        with self._lock:
            numbers = dict(self._numbers)
            while numbers.get("learned_episodes", 0) >= (self._printed + 1) * per_iteration:
                recent = self._recent_episodes(self._printed)
                self._printed += 1
                if recent:  # not of an earlier part of a resumed run
                    self._print_iteration(recent, numbers)

    def _print_iteration(
        self, recent: Sequence[tuple[float, float]], numbers: Mapping[str, float]
    ) -> None:
        minutes = (time.monotonic() - self._began_secs) / 60
        self._console.print(
            f"iteration {self._printed} of {self._schedule.iterations}: "
            f"return {_mean_and_last([value for value, _ in recent])}, "
            f"success {_percentage([value for _, value in recent])}, "
            f"{numbers.get('transitions_per_sec', 0):.1f} transitions/s, "
            f"lag {numbers.get('policy_lag', 0):.0f}, "
            f"loss {numbers.get('loss', float('nan')):.4g}, {minutes:.1f} min",
            highlight=False,
            soft_wrap=True,
        )


def _mean_and_last(returns: Sequence[float]) -> str:
    if not returns:
        return "-"
    return f"{sum(returns) / len(returns):.2f} (mean of {len(returns)}; last {returns[-1]:.2f})"


def _percentage(successes: Sequence[float]) -> str:
    return f"{sum(successes) / len(successes):.0%}" if successes else "-"
