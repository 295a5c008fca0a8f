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

Episode = tuple[str, int]
"""Incarnation of the actor, and its count of episodes."""


@dataclass(frozen=True)
class Match:
    """What environments played, beside what was journalled of it."""

    played: dict[Episode, list[Step]]
    missing: Counter[Episode]
    """Steps of each episode that are not in the journal; 0 for most."""
    journalled: int
    strangers: list[str]
    """Journalled trajectories without an episode of their own: doubles, and what nobody played."""


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
    with JournalReader(journal_path) as journal:
        match = match_episodes(step_log, journal)
        assert not match.strangers, match.strangers
        accepted, learned = _accepted(journal)
    acted = sum(map(len, match.played.values()))
    return Account(acted, match.journalled, match.missing.total(), learned, accepted)


def match_episodes(step_log: Path, journal: JournalReader) -> Match:
    """Finds the episode of each journalled trajectory; an episode is found once."""
    played = _played(step_log)
    missing = Counter({episode: len(steps) for episode, steps in played.items()})
    by_start: defaultdict[tuple[str, Step], list[Episode]] = defaultdict(list)
    for episode, steps in played.items():
        by_start[episode[0], steps[0]].append(episode)
    journalled, strangers = 0, []
    for entry in journal.entries(prefix="trajectory/"):
        trajectory = decode(entry.payload, Trajectory)
        assert encode(trajectory) == entry.payload
        steps = _steps(trajectory)
        journalled += len(steps)
        candidates = by_start[trajectory.id.incarnation, steps[0]]
        found = next((it for it in candidates if played[it][: len(steps)] == steps), None)
        if found is None:
            strangers.append(entry.name)
        else:
            candidates.remove(found)  # a second trajectory of the same episode finds none
            missing[found] -= len(steps)
    return Match(played, missing, journalled, strangers)


def _played(step_log: Path) -> dict[Episode, list[Step]]:
    episodes: defaultdict[Episode, list[Step]] = defaultdict(list)
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
