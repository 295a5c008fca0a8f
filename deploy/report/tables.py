"""The tables of a report: numbers as text, each with its unit."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

from broker_config.messages import Command, Verdict
from deploy.evaluation.scores import Score
from deploy.report.composition import RewardedIteration
from deploy.report.figures import DISCRIMINATOR_NAMES
from deploy.report.record import Iteration, RunRecord

T = TypeVar("T")

_MOST_ROWS: Final = 60
_NONE: Final = "-"


@dataclass(frozen=True)
class Table:
    """Rows of text under named columns; the first column names its row."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


def duration(secs: float) -> str:
    """A time for a person: 8.1 s, 12 min 03 s, 5 h 12 min, 3 d 4 h."""
    if secs < 60:
        return f"{secs:.1f} s"
    whole = round(secs)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02} s"
    minutes = whole // 60
    if minutes < 48 * 60:
        return f"{minutes // 60} h {minutes % 60:02} min"
    return f"{minutes // 1440} d {minutes % 1440 // 60} h"


def moment(unix_secs: float) -> str:
    """A date and time of day, in UTC: wherever a report is made, it says the same."""
    at = datetime.datetime.fromtimestamp(unix_secs, datetime.UTC)
    return at.strftime("%Y-%m-%d %H:%M:%S UTC")


def thinned(rows: Sequence[T], most: int = _MOST_ROWS) -> tuple[list[T], str]:
    """Every so many rows with the last one, and a word on it if any are left out."""
    every = math.ceil(len(rows) / most) if rows else 1
    if every == 1:
        return list(rows), ""
    kept = [*rows[:-1:every], rows[-1]]
    return kept, f"Each {every}th of {len(rows)} rows, and the last."


# Learning -------------------------------------------------------------------------------------


def iteration_table(iterations: Sequence[Iteration]) -> Table:
    """Return, success, samples and lag."""
    kept, note = thinned(iterations)
    rows = [
        (
            f"{it.number + 1}",
            f"{it.mean_return:.2f}",
            f"{it.success_rate:.0%}",
            f"{it.samples}",
            f"{it.samples / it.phases.total:.1f}" if it.phases.total else _NONE,
            f"{it.lag}",
        )
        for it in kept
    ]
    columns = ("iteration", "mean return", "success", "samples", "samples per s", "lag, updates")
    return Table("Iterations", columns, rows, note)


def score_table(scores: Sequence[Score], episodes_before: Sequence[int]) -> Table:
    """Evaluated policies.

    Args:
        scores: Of each version and mode.
        episodes_before: That each of them had learned from.
    """
    kept, note = thinned(list(zip(scores, episodes_before, strict=True)))
    rows = [
        (
            f"{score.version}",
            f"{learned}",
            score.mode,
            f"{score.episodes}",
            f"{score.mean_return:.2f}",
            _interval(score, f"{score.return_interval[0]:.2f} to {score.return_interval[1]:.2f}"),
            f"{score.success_rate:.0%}",
            _interval(score, f"{score.success_interval[0]:.0%} to {score.success_interval[1]:.0%}"),
        )
        for score, learned in kept
    ]
    columns = (
        *("policy version", "after episodes", "actions", "episodes played"),
        *("mean return", "95 % interval", "success", "95 % interval"),
    )
    return Table("Evaluated policies", columns, rows, note)


def _interval(score: Score, text: str) -> str:
    return text if score.episodes > 1 else _NONE  # one episode has none


def reward_table(rewarded: Sequence[RewardedIteration]) -> Table:
    """What discriminators gave, and how they were doing."""
    names = [
        name for name in DISCRIMINATOR_NAMES if rewarded and f"{name}_loss" in rewarded[0].numbers
    ]
    kept, note = thinned(rewarded)
    columns = ["iteration"]
    for name in names:
        its = DISCRIMINATOR_NAMES[name]
        columns += [f"{its}: mean reward", f"{its}: loss", f"{its}: told apart", f"{its}: epochs"]
    columns.append("spread of rewards")
    rows = []
    for it in kept:
        row = [f"{it.iteration + 1}"]
        for name in names:
            row += [
                f"{it.parts[name]:.3f}" if name in it.parts else _NONE,
                f"{it.numbers[f'{name}_loss']:.3f}",
                f"{it.numbers[f'{name}_accuracy']:.0%}",
                f"{it.numbers[f'{name}_epochs']:.0f}",
            ]
        rows.append((*row, f"{it.rewards_std:.3f}"))
    return Table("Rewards and discriminators", columns, rows, note)


# Time -----------------------------------------------------------------------------------------


def phase_table(iterations: Sequence[Iteration]) -> Table:
    """What all iterations' time went into."""
    total = sum(it.phases.total for it in iterations)
    gradient = [it.gradient_secs for it in iterations if it.gradient_secs is not None]
    heard = f"  of it gradient steps (heard of {len(gradient)} of {len(iterations)} iterations)"
    phases = {
        "waiting for episodes": [it.phases.episodes for it in iterations],
        "waiting for rewards": [it.phases.rewards for it in iterations],
        "update: gradient steps, checkpoint, snapshot": [it.phases.updates for it in iterations],
        heard: gradient,
        "learner away": [it.phases.away for it in iterations],
    }
    rows = [
        (
            name,
            f"{sum(secs):.1f}",
            f"{sum(secs) / total:.0%}" if total else _NONE,
            f"{sum(secs) / len(secs):.2f}",
            f"{max(secs):.2f}",
        )
        for name, secs in phases.items()
        if any(secs)
    ]
    rows.append(
        (
            "all",
            f"{total:.1f}",
            "100%",
            f"{total / max(1, len(iterations)):.2f}",
            _longest(iterations),
        )
    )
    columns = ("phase", "sum, s", "share", "mean of an iteration, s", "longest, s")
    return Table("Time of each phase", columns, rows)


def _longest(iterations: Sequence[Iteration]) -> str:
    return f"{max((it.phases.total for it in iterations), default=0.0):.2f}"


def phase_rows(iterations: Sequence[Iteration]) -> Table:
    """The same of each iteration."""
    kept, note = thinned(iterations)
    rows = [
        (
            f"{it.number + 1}",
            f"{it.phases.episodes:.2f}",
            f"{it.phases.rewards:.2f}",
            f"{it.phases.updates:.2f}",
            _NONE if it.gradient_secs is None else f"{it.gradient_secs:.2f}",
            f"{it.phases.away:.2f}",
        )
        for it in kept
    ]
    columns = (
        *("iteration", "waiting for episodes, s", "waiting for rewards, s", "update, s"),
        *("of it gradient steps, s", "learner away, s"),
    )
    return Table("Phases of each iteration", columns, rows, note)


# Processes ------------------------------------------------------------------------------------


def life_table(record: RunRecord) -> Table:
    """When each process lived."""
    kept, note = thinned(record.lives)
    rows = [
        (
            "learner" if life.role == "owner" else life.id,
            f"{life.began_secs - record.first_secs:.1f}",
            f"{life.ended_secs - record.first_secs:.1f}",
            f"{life.ended_secs - life.began_secs:.1f}",
            "seen to end" if life.was_seen_to_end else "last heard of",
        )
        for life in kept
    ]
    columns = ("process", "from, s", "to, s", "for, s", "its end")
    return Table("Lives, in seconds since the run began", columns, rows, note)


def attempt_table(record: RunRecord) -> Table:
    """What came of each actor's tickets."""
    rows = []
    for actor, tally in thinned(list(record.attempts.items()))[0]:
        counts = [f"{tally.verdicts[verdict]}" for verdict in Verdict]
        starts = f"{record.actor_starts[actor]}"
        rows.append((actor or "unknown", starts, f"{tally.issued}", *counts, f"{tally.steps}"))
    names = [str(verdict) for verdict in Verdict]
    columns = ("actor", "starts", "tickets", *names, "steps that count")
    return Table("Attempts by actor", columns, rows)


def wrong_table(record: RunRecord) -> Table:
    """Attempts that did not count, one by one."""
    rows = [
        (
            f"{it.ticket}",
            f"{it.attempt + 1}",
            it.actor or "unknown",
            str(it.verdict),
            it.reason,
            f"{it.unix_secs - record.first_secs:.1f}",
        )
        for it in record.wrong
    ]
    left = record.n_wrong - len(rows)
    note = f"And {left} more." if left else ""
    columns = ("ticket", "attempt", "actor", "verdict", "reason", "after, s")
    return Table("Attempts that did not count", columns, rows, note)


def order_table(record: RunRecord) -> Table:
    """What people asked of the run."""
    rows = [
        (f"{it.unix_secs - record.first_secs:.1f}", str(it.command), it.process or "all")
        for it in record.orders
    ]
    return Table("Orders", ("after, s", "order", "to"), rows)


def fault_table(record: RunRecord) -> Table:
    """What went wrong, and what became of it."""
    verdicts = record.verdicts
    forgotten = sum(it.command is Command.FORGET for it in record.orders)
    actors = sum(max(0, starts - 1) for starts in record.actor_starts.values())
    away = duration(record.away_secs)
    found = [
        (
            "the learner started again",
            len(record.starts) - 1,
            f"away for {away} in all; it went on from its checkpoint and the journal",
        ),
        ("actors started again", actors, "what they had spooled was delivered"),
        (
            "attempts lost with their actor",
            verdicts.get(Verdict.LOST, 0),
            "the same seed was played again, by the next actor that asked",
        ),
        (
            "attempts invalid",
            verdicts.get(Verdict.INVALID, 0),
            "kept in the journal, not learned from; the seed was replaced",
        ),
        (
            "spare attempts",
            verdicts.get(Verdict.SPARE, 0),
            "another attempt of the ticket was complete first; not learned from",
        ),
        (
            "attempts that nobody asked for",
            verdicts.get(Verdict.UNASKED, 0),
            "kept in the journal, not learned from",
        ),
        ("seeds replaced", record.reseeded, "each ticket has ended with another seed"),
        (
            "discriminators started again",
            max(0, record.discriminator_starts - 1),
            "their state is in the journal, with the rewards that it gave",
        ),
        ("followers given up", forgotten, "policy versions were not kept for them any more"),
        *_recorded_faults(record),
        ("episodes counted twice", record.repeated, "must be 0"),
    ]
    rows = [(what, f"{count}", outcome if count else "") for what, count, outcome in found]
    return Table("Faults, and what became of them", ("fault", "times", "outcome"), rows)


def _recorded_faults(record: RunRecord) -> list[tuple[str, int, str]]:
    if (recorded := record.recorded) is None:
        return []
    away = duration(sum(until - since for since, until in recorded.away))
    kinds = ", ".join(f"{count} of {kind}" for kind, count in sorted(recorded.gaps.items()))
    return [
        (
            "the evaluator started again",
            max(0, record.evaluator_starts - 1),
            "episodes that were in its file were not played again",
        ),
        (
            "the recorder started again",
            len(recorded.away),
            f"away for {away} in all; it pulled the journal's entries that it had missed",
        ),
        (
            "live messages not recorded",
            sum(recorded.gaps.values()),
            f"{kinds}: best effort, the gaps are marked",
        ),
        (
            "policy versions not recorded",
            len(recorded.lost_policies),
            f"versions {', '.join(map(str, recorded.lost_policies[:20]))}",
        ),
    ]


def n_survived(record: RunRecord) -> int:
    """Starts beyond the first, and attempts that had to be made again."""
    starts = len(record.starts) - 1 + sum(max(0, it - 1) for it in record.actor_starts.values())
    starts += max(0, record.discriminator_starts - 1) + max(0, record.evaluator_starts - 1)
    starts += len(record.recorded.away) if record.recorded else 0
    again = record.verdicts.get(Verdict.LOST, 0) + record.verdicts.get(Verdict.INVALID, 0)
    return starts + again
