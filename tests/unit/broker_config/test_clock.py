"""The wall clock jumps back by hours: nothing that is kept depends on it."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from broker_config.journal import Journal, JournalReader
from broker_config.messages import Ticket, Trajectory
from broker_config.spool import Spool


@pytest.fixture
def backwards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each look at the wall clock shows an hour less than the last."""
    times = itertools.count(1e9, -3600.0)
    monkeypatch.setattr("time.time", lambda: next(times))


@pytest.mark.usefixtures("backwards")
def test_journal_entries_keep_their_order_and_are_found(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    for start in (0, 10):  # the second time as after a restart
        with Journal(path) as journal:
            for number in range(start, start + 10):
                journal.append([(f"entry-{number}", b"x")]).result(20)
            again = journal.append([("entry-0", b"y")]).result(20)
            assert (again[0].offset, again[0].is_new) == (0, False)
    with JournalReader(path) as reader:
        entries = list(reader)
        assert [entry.name for entry in entries] == [f"entry-{number}" for number in range(20)]
        assert [entry.offset for entry in entries] == list(range(20))
        assert [entry.name for entry in reader.read(18, 100)] == ["entry-18", "entry-19"]
    seen_secs = [entry.unix_secs for entry in entries]
    assert seen_secs == sorted(seen_secs, reverse=True), "the clock did not go backwards"


@pytest.mark.usefixtures("backwards")
def test_a_spool_keeps_its_order_and_an_interrupted_episode_its_steps(
    tmp_path: Path, make_trajectory: Callable[..., Trajectory]
) -> None:
    path = tmp_path / "spool.sqlite"
    picture = np.zeros((84, 84, 1), np.uint8)
    with Spool(path, "run", "actor-01", "inc-1", 64 << 20) as spool:
        for _ in range(3):
            spool.put(make_trajectory(spool.next_id().sequence))
        spool.begin(spool.next_id(), Ticket(3, 0, 0, 7, 0, 5, 0.0), picture)
        for action in range(4):
            spool.append_step(action, 1.0, picture + action)
    with Spool(path, "run", "actor-01", "inc-2", 64 << 20) as spool:
        recovered = spool.recover()
        assert recovered is not None
        assert recovered.actions.tolist() == [0, 1, 2, 3]
        assert [item.id.sequence for item in spool.pending()] == [0, 1, 2, 3]
        assert spool.next_id().sequence == 4
