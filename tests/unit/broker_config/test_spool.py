"""The spool, with real files and real processes that are killed."""

import os
import signal
import sqlite3
import subprocess
import sys

import numpy as np
import pytest

from broker_config.codec import decode, encode
from broker_config.errors import AlreadyOwned, MessageError, SpoolFull, StorageError
from broker_config.messages import Ticket, Trajectory, TrajectoryId
from broker_config.spool import Spool

TICKET = Ticket(index=4, attempt=1, part=0, seed=7, policy_version=2, steps=10, epsilon=0.0)
MIB = 1 << 20


def picture(value):
    return np.full((84, 84, 3), value, np.uint8)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "spool.sqlite"


@pytest.fixture
def open_spool(path):
    def open_(incarnation="inc-1", max_bytes=16 * MIB, actor="actor-01", run="run"):
        return Spool(path, run, actor, incarnation, max_bytes)

    return open_


def test_whole_episodes_wait_in_order_until_they_are_acknowledged(open_spool, make_trajectory):
    with open_spool() as spool:
        trajectories = [make_trajectory(spool.next_id().sequence) for _ in range(3)]
        for trajectory in trajectories:
            spool.put(trajectory)
        spool.put(trajectories[0])
        assert [item.id for item in spool.pending()] == [t.id for t in trajectories]
        assert [item.payload for item in spool.pending()] == [encode(t) for t in trajectories]
        assert spool.status().trajectories == 3
        assert spool.acknowledge(trajectories[1].id)
        assert not spool.acknowledge(trajectories[1].id)
        assert [item.id.sequence for item in spool.pending()] == [0, 2]
    with open_spool("inc-2") as spool:  # and across a restart, under their first incarnation
        assert [str(item.id) for item in spool.pending()] == [
            "actor-01/inc-1/0",
            "actor-01/inc-1/2",
        ]


def test_acknowledging_while_iterating_is_fine(open_spool, make_trajectory):
    with open_spool() as spool:
        for _ in range(3):
            spool.put(make_trajectory(spool.next_id().sequence))
        for item in spool.pending():
            assert spool.acknowledge(item.id)
        assert list(spool.pending()) == []
        assert spool.status().used_bytes == 0


def test_sequence_numbers_never_repeat(open_spool, make_trajectory):
    with open_spool() as spool:
        assert [spool.next_id().sequence for _ in range(3)] == [0, 1, 2]
        spool.put(make_trajectory(2))
        spool.acknowledge(TrajectoryId("actor-01", "inc-1", 2))
    with open_spool("inc-2") as spool:
        assert spool.next_id() == TrajectoryId("actor-01", "inc-2", 3)


def test_a_full_spool_says_so_and_takes_more_after_an_acknowledgement(open_spool, make_trajectory):
    size = len(encode(make_trajectory(0)))
    with open_spool(max_bytes=2 * size + 100) as spool:
        for sequence in range(2):
            spool.put(make_trajectory(sequence))
        with pytest.raises(SpoolFull, match=f"expected room for {size} bytes; got {2 * size} of"):
            spool.put(make_trajectory(2))
        spool.acknowledge(make_trajectory(0).id)
        spool.put(make_trajectory(2))


def test_room_for_all_steps_is_reserved_before_the_robot_moves(open_spool, make_trajectory):
    with open_spool(max_bytes=11 * picture(0).nbytes) as spool, pytest.raises(SpoolFull):
        spool.begin(spool.next_id(), TICKET, picture(0))
    with open_spool(max_bytes=12 * picture(0).nbytes) as spool:
        spool.begin(spool.next_id(), TICKET, picture(0))
        with pytest.raises(SpoolFull):  # not even something small may take the reserved room
            spool.put(make_trajectory(spool.next_id().sequence, steps=1))
        for step in range(TICKET.steps):
            spool.append_step(step, 0.0, picture(step))
        assert spool.status().open_steps == 10
        spool.finish()
        assert spool.status().used_bytes <= 12 * picture(0).nbytes


def test_an_episode_written_step_by_step_becomes_a_trajectory(open_spool):
    with open_spool() as spool:
        first = spool.next_id()
        spool.begin(first, TICKET, picture(10))
        spool.append_step(3, 0.5, picture(11))
        spool.append_step(4, -0.5, picture(12), terminated=True, success=True)
        done = spool.finish()
        (item,) = spool.pending()
        sent = decode(item.payload, Trajectory)
        for trajectory in (done, sent):
            assert trajectory.id == first
            assert trajectory.ticket == TICKET
            assert trajectory.observations.shape == (3, 84, 84, 3)
            assert [int(picture[0, 0, 0]) for picture in trajectory.observations] == [10, 11, 12]
            assert trajectory.actions.tolist() == [3, 4]
            assert trajectory.rewards.tolist() == [0.5, -0.5]
            flags = (trajectory.terminated, trajectory.truncated, trajectory.success)
            assert flags == (True, False, True)
            assert not trajectory.interrupted
        spool.begin(spool.next_id(), TICKET, picture(0))
        assert spool.finish() is None
        assert spool.status().trajectories == 1
        assert spool.recover() is None


def test_a_guarded_step_stays_guarded_when_the_actor_dies_right_after_it(open_spool):
    with open_spool() as spool:
        spool.begin(spool.next_id(), TICKET, picture(0))
        spool.append_step(0, 0.0, picture(1), guard="overstretched")
    with open_spool("inc-2") as spool:
        recovered = spool.recover()
    assert (recovered.guard, recovered.interrupted) == ("overstretched", True)


def test_a_spool_belongs_to_one_run(open_spool):
    with open_spool():
        pass
    with pytest.raises(StorageError, match="expected the spool of actor-01 in run other"):
        open_spool(run="other")


KILLED_ACTOR = """
import itertools, sys
from pathlib import Path
import numpy as np
from broker_config.messages import Ticket
from broker_config.spool import Spool
spool = Spool(Path(sys.argv[1]), "run", "actor-01", "inc-1", 64 << 20)
spool.begin(spool.next_id(), Ticket(4, 1, 0, 7, 2, 1000, 0.0), np.zeros((84, 84, 3), np.uint8))
for step in range(int(sys.argv[2])):
    spool.append_step(step, float(step), np.full((84, 84, 3), step + 1, np.uint8))
    print(step, flush=True)
print("waiting", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("when", [0, 5, 200])
def test_after_kill_9_every_finished_step_is_recovered_once(path, open_spool, when):
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED_ACTOR, path, str(when)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    stop_at = "waiting\n" if when < 100 else "20\n"  # the last one is killed on its way
    lines = []
    while not lines or lines[-1] != stop_at:
        lines.append(process.stdout.readline())
    os.kill(process.pid, signal.SIGKILL)
    rest, _ = process.communicate()
    written = len([line for line in [*lines, *rest.splitlines()] if line.strip().isdigit()])
    with open_spool("inc-2", max_bytes=64 * MIB) as spool:
        if when > 0:
            with pytest.raises(StorageError, match="recover it after a crash"):
                spool.begin(spool.next_id(), TICKET, picture(0))
        recovered = spool.recover()
        assert spool.recover() is None
        if when == 0:
            assert recovered is None
            assert list(spool.pending()) == []
            return
        assert recovered.steps in (written, written + 1)  # a report may not have left
        assert (recovered.interrupted, recovered.truncated, recovered.terminated) == (
            True,
            True,
            False,
        )
        assert str(recovered.id) == "actor-01/inc-1/0"
        assert recovered.actions.tolist() == list(range(recovered.steps))
        assert recovered.observations[-1, 0, 0, 0] == recovered.steps % 256
        (item,) = spool.pending()
        assert decode(item.payload, Trajectory).steps == recovered.steps
        assert spool.next_id().sequence >= 1


def test_steps_that_no_trajectory_can_hold_are_refused_and_leave_the_episode_usable(open_spool):
    with open_spool() as spool:
        with pytest.raises(StorageError, match="call begin first"):
            spool.append_step(0, 0.0, picture(0))
        with pytest.raises(StorageError, match="call begin first"):
            spool.finish()
        spool.begin(spool.next_id(), TICKET, picture(0))
        for step, text in (
            ((0, 0.0, np.zeros((42, 42, 3), np.uint8)), "a camera's settings have changed"),
            ((0, 0.0, np.zeros((84, 84, 3), np.float32)), "got float32"),
            ((-1, 0.0, picture(0)), "action: expected an index"),
            ((0, float("nan"), picture(0)), "reward: expected a finite number"),
        ):
            with pytest.raises(MessageError, match=text):
                spool.append_step(*step)
        spool.append_step(0, 0.0, picture(1))
        assert spool.finish().steps == 1


def test_ids_of_other_actors_and_incarnations_are_refused(open_spool, make_trajectory):
    with open_spool("inc-2") as spool:
        for wrong in (make_trajectory(0), make_trajectory(0, actor="a", incarnation="inc-2")):
            with pytest.raises(MessageError, match="expected one of actor-01/inc-2"):
                spool.put(wrong)


def test_an_episode_too_long_for_the_bus_is_refused_before_it_begins(open_spool):
    endless = Ticket(0, 0, 0, 7, 0, 1_000_000, 0.0)
    with open_spool() as spool, pytest.raises(MessageError, match="choose a shorter horizon"):
        spool.begin(spool.next_id(), endless, picture(0))


def test_a_spool_belongs_to_one_actor_and_one_process(path, open_spool):
    with open_spool(), pytest.raises(AlreadyOwned, match=f"spool .* got pid {os.getpid()}"):
        open_spool("inc-2")
    with pytest.raises(StorageError, match="expected the spool of actor-02 in run run; got"):
        open_spool(actor="actor-02")
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version=9")
    connection.close()
    with pytest.raises(StorageError, match="expected schema version 1; got 9"):
        open_spool()


def test_a_closed_spool_says_so(open_spool):
    spool = open_spool()
    spool.close()
    spool.close()
    with pytest.raises(StorageError, match="it has been closed"):
        spool.next_id()
