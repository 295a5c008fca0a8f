"""Followers: nothing that one of them lacks is thrown away, and nobody waits for those who left."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from broker_config.errors import StorageError
from broker_config.journal import Journal
from broker_config.messages import (
    Command,
    Control,
    FollowerJoined,
    JournalBatch,
    JournalEntry,
    JournalRequest,
    SnapshotTaken,
    Ticket,
    Trajectory,
    TrajectoryId,
)
from deploy.presets import load_preset
from learner.followers import Followers
from learner.owner import Owner

PRESET = load_preset("reaching-smoke", ["task.horizon=3"])
MOST_BYTES = 1 << 20


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    with Journal(tmp_path / "journal.sqlite") as opened:
        yield opened


def request(
    name: str = "recorder", offset: int = 0, held: int = 0, most: int = MOST_BYTES
) -> JournalRequest:
    return JournalRequest("recorder", name, "life", offset, held, most)


def taken(version: int) -> SnapshotTaken:
    return SnapshotTaken(version, "ab" * 32, 0)


def following(*names: str) -> Followers:
    followers = Followers()
    for name in names:
        followers.apply(FollowerJoined("recorder", name))
    return followers


# Who they are and what they lack --------------------------------------------------------------


def test_versions_are_missing_until_every_follower_holds_the_entry_that_names_them() -> None:
    followers = following("one", "two")
    for version, offset in ((0, 1), (1, 5), (2, 9)):
        followers.snapshot_taken(taken(version), offset)
    assert followers.missing_versions() == {0, 1, 2}
    followers.heard(request("one", held=10), 0.0)
    assert followers.missing_versions() == {0, 1, 2}
    followers.heard(request("two", held=5), 0.0)
    assert followers.missing_versions() == {1, 2}, "offset 5 itself is not held yet"
    followers.heard(request("two", held=10), 0.0)
    assert followers.missing_versions() == frozenset()


def test_without_followers_nothing_is_missing_and_what_was_is_not_remembered() -> None:
    followers = Followers()
    followers.snapshot_taken(taken(0), 1)
    assert followers.missing_versions() == frozenset()
    followers.apply(FollowerJoined("recorder", "late"))
    followers.snapshot_taken(taken(1), 3)
    assert followers.missing_versions() == {1}


def test_who_is_forgotten_is_waited_for_no_more() -> None:
    followers = following("one", "two")
    followers.snapshot_taken(taken(0), 1)
    followers.heard(request("two", held=2), 0.0)
    followers.forget("one")
    assert not followers.is_known("one")
    assert followers.missing_versions() == frozenset()
    followers.forget(None)
    assert not followers.is_known("two")
    followers.heard(request("two", held=3), 0.0)
    assert followers.behind(9, -1.0) == []


def test_only_those_that_lack_something_and_were_heard_of_are_behind() -> None:
    followers = following("ahead", "behind", "silent")
    followers.heard(request("ahead", held=7), 5.0)
    followers.heard(request("behind", held=6), 5.0)
    followers.heard(request("silent", held=0), 1.0)
    assert followers.behind(7, heard_since_secs=2.0) == ["behind"]
    followers.expect(now_secs=6.0)
    assert followers.behind(7, heard_since_secs=2.0) == ["behind", "silent"]


# The owner ------------------------------------------------------------------------------------


def follow(owner: Owner, *arguments: JournalRequest) -> JournalBatch:
    (one,) = arguments
    return owner.follow(one, MOST_BYTES, now_secs=0.0)


def test_a_follower_gets_everything_in_batches_of_its_size(journal: Journal) -> None:
    owner = Owner("run", PRESET, journal)
    journal.append([(f"trajectory/a/life/{n}", bytes([n]) * 1000) for n in range(10)]).result(10)
    found: list[JournalEntry] = []
    while True:
        batch = follow(owner, request(offset=len(found), most=2500))
        if not batch.entries:
            break
        assert len(batch.entries) <= 2 or sum(len(it.payload) for it in batch.entries) <= 2500
        found += batch.entries
    assert found == list(journal)
    assert [it.offset for it in found] == list(range(journal.end_offset))
    assert batch.end_offset == journal.end_offset
    assert (batch.owner_epoch, batch.is_final) == (owner.epoch, False)


def test_an_entry_larger_than_the_batch_still_comes(journal: Journal) -> None:
    owner = Owner("run", PRESET, journal)
    journal.append([("trajectory/a/life/0", b"x" * 5000)]).result(10)
    batch = follow(owner, request(offset=1, most=10))
    assert [len(it.payload) for it in batch.entries] == [5000]


def test_the_owner_has_the_last_word_on_a_batch_s_size(journal: Journal) -> None:
    owner = Owner("run", PRESET, journal)
    journal.append([(f"trajectory/a/life/{n}", b"x" * 1000) for n in range(9)]).result(10)
    batch = owner.follow(request(offset=1, most=1 << 30), max_bytes=3000, now_secs=0.0)
    assert len(batch.entries) == 3


def test_a_new_follower_is_journaled_once_and_known_to_the_next_owner(journal: Journal) -> None:
    owner = Owner("run", PRESET, journal)
    for _ in range(3):
        follow(owner, request())
    follow(owner, request("second"))
    joined = [it.name for it in journal.entries(prefix="follower/")]
    assert joined == ["follower/recorder/1/1", "follower/second/1/2"]
    owner.policy_ready(taken(0))
    again = Owner("run", PRESET, journal)
    assert again.followers.missing_versions() == {0}, "until they say so again"
    follow(again, request(held=journal.end_offset))
    follow(again, request("second", held=journal.end_offset))
    assert again.followers.missing_versions() == frozenset()
    assert len(journal.entries(prefix="follower/")) == 2


def test_one_that_joins_on_many_threads_joins_soundly(journal: Journal) -> None:
    owner = Owner("run", PRESET, journal)
    threads = [threading.Thread(target=follow, args=(owner, request())) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert owner.followers.is_known("recorder")
    assert len({it.name for it in journal.entries(prefix="follower/")}) >= 1


def test_a_forgotten_follower_stays_forgotten_until_it_comes_back(journal: Journal) -> None:
    owner = Owner("run", PRESET, journal)
    follow(owner, request())
    owner.control(Control(Command.FORGET, "recorder"))
    owner.policy_ready(taken(0))
    assert owner.followers.missing_versions() == frozenset()
    again = Owner("run", PRESET, journal)
    assert not again.followers.is_known("recorder")
    follow(again, request())
    assert again.followers.is_known("recorder")


def test_a_record_that_is_closed_is_final_and_takes_nothing_more(journal: Journal) -> None:
    owner = Owner("run", PRESET, journal)
    follow(owner, request())
    end_offset = owner.close_record()
    assert end_offset == journal.end_offset
    batch = follow(owner, request(offset=end_offset, held=end_offset))
    assert (batch.entries, batch.end_offset, batch.is_final) == ((), end_offset, True)
    assert owner.followers.behind(end_offset, -1.0) == []
    with pytest.raises(StorageError, match="what was sent is sent again"):
        owner.receive(_trajectory(), b"payload")
    assert journal.end_offset == end_offset


def _trajectory() -> Trajectory:
    return Trajectory(
        id=TrajectoryId("a", "life", 0),
        ticket=Ticket(0, 0, 0, 7, 0, 3, 0.0),
        observations=np.zeros((4, 84, 84, 1), np.uint8),
        actions=np.zeros(3, np.int32),
        rewards=np.zeros(3, np.float32),
        terminated=False,
        truncated=True,
        success=False,
        guard=None,
        interrupted=False,
        ended_unix_secs=0.0,
    )
