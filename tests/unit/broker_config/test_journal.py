"""The journal, with real files and real processes that are killed."""

import os
import signal
import sqlite3
import subprocess
import sys
import threading
from concurrent.futures import wait

import pytest

from broker_config.errors import StorageError
from broker_config.journal import Appended, Journal, JournalReader


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run" / "journal.sqlite"


def append(journal, *names, payload=b"x"):
    return journal.append([(name, payload) for name in names]).result(timeout=20)


def test_entries_get_offsets_from_zero_and_are_read_back(path):
    with Journal(path) as journal:
        assert journal.end_offset == 0
        assert append(journal, "a", "b") == (Appended(0, True), Appended(1, True))
        assert append(journal, "c", payload=b"last") == (Appended(2, True),)
        assert journal.end_offset == 3
        assert [entry.name for entry in journal] == ["a", "b", "c"]
        assert journal.find("c").payload == b"last"
        assert journal.find("d") is None


def test_a_name_that_is_there_adds_nothing(path):
    with Journal(path) as journal:
        append(journal, "a", payload=b"first")
        assert append(journal, "a", "b", payload=b"again") == (
            Appended(0, False),
            Appended(1, True),
        )
        assert append(journal, "c", "c")[1] == Appended(2, False)
        assert journal.find("a").payload == b"first"
        assert journal.end_offset == 3


def test_a_resend_after_a_lost_ack_adds_nothing_also_after_a_restart(path):
    with Journal(path) as journal:
        append(journal, "actor-01/inc-1/0")
    with Journal(path) as journal:
        assert append(journal, "actor-01/inc-1/0") == (Appended(0, False),)
        assert append(journal, "actor-01/inc-1/1") == (Appended(1, True),)


def test_batches_end_before_the_limit_but_hold_one_entry(path):
    with Journal(path) as journal:
        append(journal, "a", "b", "c", payload=bytes(100))
        assert [e.offset for e in journal.read(0, max_bytes=250)] == [0, 1]
        assert [e.offset for e in journal.read(0, max_bytes=200)] == [0, 1]
        assert [e.offset for e in journal.read(1, max_bytes=1)] == [1]
        assert journal.read(3, max_bytes=1000) == ()


def test_appends_of_many_threads_are_dense_and_each_call_is_together(path):
    with Journal(path) as journal:

        def work(worker):
            for index in range(20):
                first, second = append(journal, f"{worker}-{index}-a", f"{worker}-{index}-b")
                assert second.offset == first.offset + 1

        threads = [threading.Thread(target=work, args=[worker]) for worker in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        entries = list(journal)
    assert [entry.offset for entry in entries] == list(range(160))
    assert len({entry.name for entry in entries}) == 160


def test_a_future_resolves_after_the_commit_only(path):
    """While another connection holds the write lock nothing can commit, so nothing may resolve."""
    with Journal(path) as journal:
        blocker = sqlite3.connect(path, isolation_level=None)
        blocker.execute("BEGIN IMMEDIATE")
        futures = [journal.append([(f"entry-{index}", b"x")]) for index in range(10)]
        assert not wait(futures, timeout=0.2).done
        blocker.execute("COMMIT")
        blocker.close()
        assert not wait(futures, timeout=20).not_done
        assert journal.end_offset == 10


def test_a_committed_entry_is_visible_to_another_process_when_its_future_resolves(path):
    with Journal(path) as journal, JournalReader(path) as follower:
        for index in range(20):
            append(journal, f"entry-{index}")
            assert follower.end_offset == index + 1


def test_a_burst_is_committed_in_groups(path):
    with Journal(path) as journal:
        blocker = sqlite3.connect(path, isolation_level=None)
        blocker.execute("BEGIN IMMEDIATE")
        futures = [journal.append([(f"entry-{index}", b"x")]) for index in range(50)]
        ends = set()
        for future in futures:
            future.add_done_callback(lambda _: ends.add(journal.end_offset))
        blocker.execute("COMMIT")
        blocker.close()
        assert not wait(futures, timeout=20).not_done
    # What had queued up behind the first is one commit: at most two ends were ever visible.
    assert len(ends) <= 2
    assert 50 in ends


def test_when_the_disk_refuses_nothing_is_half_appended_and_later_appends_work(path):
    script = """
import resource, sys
from pathlib import Path
from broker_config.errors import StorageError
from broker_config.journal import Journal
with Journal(Path(sys.argv[1])) as journal:
    journal.append([("before", b"x")]).result()
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, resource.RLIM_INFINITY))
    future = journal.append([("small", b"x"), ("large", bytes(2_000_000))])
    try:
        future.result()
    except StorageError as error:
        print(error)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert [entry.name for entry in journal] == ["before"]
    assert journal.append([("after", b"x")]).result()[0].offset == 1
"""
    ended = subprocess.run(
        [sys.executable, "-c", script, path], capture_output=True, text=True, check=True
    )
    assert "check space, quota and disk" in ended.stdout


def test_kill_9_in_the_middle_of_appends_loses_nothing_that_was_acked(path):
    script = """
import itertools, sys
from pathlib import Path
from broker_config.journal import Journal
journal = Journal(Path(sys.argv[1]))
for index in itertools.count():
    journal.append([(f"entry-{index}", index.to_bytes(4, "big") * 5000)]).result()
    print(index, flush=True)
"""
    process = subprocess.Popen(
        [sys.executable, "-c", script, path], stdout=subprocess.PIPE, text=True
    )
    last_acked = 0
    while last_acked < 40:
        last_acked = int(process.stdout.readline())
    os.kill(process.pid, signal.SIGKILL)
    rest, _ = process.communicate()
    acked = [int(line) for line in rest.splitlines(keepends=True) if line.endswith("\n")]
    last_acked = max([last_acked, *acked])
    with Journal(path) as journal:
        entries = list(journal)
        assert len(entries) in (last_acked + 1, last_acked + 2)  # the last ack may not have left
        for index, entry in enumerate(entries):
            assert (entry.offset, entry.name) == (index, f"entry-{index}")
            assert entry.payload == index.to_bytes(4, "big") * 5000
        assert append(journal, "after")[0].offset == len(entries)


def test_readers_read_while_the_owner_writes(path):
    with Journal(path) as journal:
        finished = threading.Event()
        problems = []

        def follow():
            offset = 0
            while not (finished.is_set() and offset == 200):
                for entry in journal.read(offset, max_bytes=10_000):
                    if entry.offset != offset:
                        problems.append(entry)
                    offset += 1

        followers = [threading.Thread(target=follow) for _ in range(2)]
        for follower in followers:
            follower.start()
        futures = [journal.append([(f"entry-{index}", bytes(1000))]) for index in range(200)]
        wait(futures)
        finished.set()
        for follower in followers:
            follower.join()
    assert not problems


def test_a_follower_opens_a_journal_whose_owner_is_gone(path):
    with Journal(path) as journal:
        append(journal, "a")
    with JournalReader(path) as follower:
        assert [entry.name for entry in follower] == ["a"]
        assert not hasattr(follower, "append")


def test_closing_commits_what_is_queued_and_ends_the_journal(path):
    journal = Journal(path)
    futures = [journal.append([(f"entry-{index}", b"x")]) for index in range(100)]
    journal.close()
    journal.close()
    assert all(future.done() for future in futures)
    for use in (lambda: journal.append([("late", b"x")]), lambda: journal.read(0, 1)):
        with pytest.raises(StorageError, match="closed"):
            use()
    with JournalReader(path) as follower:
        assert follower.end_offset == 100


def test_a_payload_of_a_wrong_type_is_refused_before_it_can_spoil_a_commit(path):
    with Journal(path) as journal:
        with pytest.raises(TypeError, match="expected bytes under a text name; got list under str"):
            journal.append([("a", b"x"), ("b", [1])])
        assert journal.end_offset == 0
        assert append(journal, "c")[0].offset == 0


def test_files_that_are_no_journal_are_refused(path, tmp_path):
    damaged = tmp_path / "damaged.sqlite"
    damaged.write_bytes(b"This is no SQLite file." * 100)
    foreign = tmp_path / "foreign.sqlite"
    with sqlite3.connect(foreign) as connection:
        connection.execute("CREATE TABLE t (x)")
    connection.close()
    for file, text in ((damaged, "something else or damaged"), (foreign, "another SQLite file")):
        for kind in (Journal, JournalReader):
            with pytest.raises(StorageError, match=text):
                kind(file)
    with pytest.raises(StorageError, match="check that file and folder exist"):
        JournalReader(path)
    with pytest.raises(StorageError, match="check path and permissions"):
        Journal(damaged / "journal.sqlite")


def test_a_journal_of_another_schema_version_is_refused(path):
    Journal(path).close()
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version=3")
    connection.close()
    for kind in (Journal, JournalReader):
        with pytest.raises(StorageError, match="expected schema version 2; got 3"):
            kind(path)
