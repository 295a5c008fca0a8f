"""Compares what environments really did with what a run's journal says."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from actors.step_log import observation_digest
from broker_config.codec import decode, encode
from broker_config.journal import JournalReader
from broker_config.messages import AttemptEnded, Trajectory, Verdict

Step = tuple[int, float, str]
"""Action, reward, digest of the picture."""


@dataclass(frozen=True)
class Account:
    """Steps on both sides."""

    acted: int
    """By the environments' log."""
    journalled: int
    cut_off: int
    """Acted in episodes that are not in the journal, or not wholly: their process was killed."""
    learned: int
    """Of accepted attempts."""
    accepted: Counter[int]
    """Accepted steps by ticket."""


def settle(step_log: Path, journal_path: Path) -> Account:
    """Matches every journalled trajectory with one episode of the log, and counts.

    Raises:
        AssertionError: The journal has a trajectory that no environment played, or one twice.
    """
    played = _played(step_log)
    remaining = Counter({episode: len(steps) for episode, steps in played.items()})
    acted = sum(remaining.values())
    by_start: defaultdict[tuple[str, Step], list[tuple[str, int]]] = defaultdict(list)
    for episode, steps in played.items():
        by_start[episode[0], steps[0]].append(episode)
    journalled = 0
    with JournalReader(journal_path) as journal:
        for entry in journal.entries(prefix="trajectory/"):
            trajectory = decode(entry.payload, Trajectory)
            assert encode(trajectory) == entry.payload
            steps = _steps(trajectory)
            candidates = by_start[trajectory.id.incarnation, steps[0]]
            match = next(it for it in candidates if played[it][: len(steps)] == steps)
            candidates.remove(match)  # a second trajectory of the same episode finds none
            remaining[match] -= len(steps)
            journalled += len(steps)
        accepted, learned = _accepted(journal)
    return Account(acted, journalled, sum(remaining.values()), learned, accepted)


def _played(step_log: Path) -> dict[tuple[str, int], list[Step]]:
    episodes: defaultdict[tuple[str, int], list[Step]] = defaultdict(list)
    for text in step_log.read_text().splitlines():
        line = json.loads(text)
        steps = episodes[line["incarnation"], line["episode"]]
        assert line["step"] == len(steps), "the log itself has a gap"
        reward = float(np.float32(line["reward"]))  # as messages carry it
        steps.append((line["action"], reward, line["observation"]))
    return dict(episodes)


def _steps(trajectory: Trajectory) -> list[Step]:
    pictures = [observation_digest(picture) for picture in trajectory.observations[1:]]
    actions, rewards = trajectory.actions.tolist(), trajectory.rewards.tolist()
    return list(zip(actions, rewards, pictures, strict=True))


def _accepted(journal: JournalReader) -> tuple[Counter[int], int]:
    by_ticket: Counter[int] = Counter()
    for entry in journal.entries(prefix="ended/"):
        ended = decode(entry.payload, AttemptEnded)
        if ended.verdict is Verdict.ACCEPTED:
            by_ticket[ended.ticket] += ended.steps
    return by_ticket, sum(by_ticket.values())
