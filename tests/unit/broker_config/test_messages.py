"""Messages refuse to exist when they are wrong."""

import dataclasses

import numpy as np
import pytest

from broker_config.errors import MessageError
from broker_config.messages import (
    Instruction,
    Snapshot,
    Ticket,
    TicketReply,
    TicketRequest,
    TrajectoryId,
    require_id,
    weights_digest,
)
from broker_config.specs import NetworkSpec

SPEC = NetworkSpec((84, 84, 3), 36, "plain", 1.0)


@pytest.mark.parametrize("name", ["a", "actor-01", "0_x", "x" * 64])
def test_ids(name):
    assert require_id("id", name) == name


@pytest.mark.parametrize("name", ["", "A", "-a", "a b", "a/b", "*", "ä", "x" * 65, "a\n"])
def test_what_is_no_id(name):
    with pytest.raises(MessageError, match="id: expected 1 to 64"):
        require_id("id", name)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"observations": np.zeros((3, 84, 84, 3), np.uint8)}, r"expected uint8 \[4, any, any"),
        ({"observations": np.zeros((4, 84, 84, 3), np.float32)}, "got float32"),
        ({"actions": np.zeros(0, np.int32)}, "at least one step"),
        ({"actions": np.zeros(3, np.int64)}, r"expected int32 \[3\]; got int64"),
        ({"actions": np.array([0, 1, -1], np.int32)}, "indices of 0 or more; got -1"),
        ({"rewards": np.zeros(2, np.float32)}, r"expected float32 \[3\]"),
        ({"rewards": np.array([0, np.nan, 0], np.float32)}, "finite numbers"),
        ({"ended_unix_secs": float("inf")}, "a finite time"),
    ],
)
def test_a_trajectory_that_contradicts_itself(make_trajectory, changes, text):
    with pytest.raises(MessageError, match=text):
        dataclasses.replace(make_trajectory(), **changes)


def test_a_trajectory_must_fit_the_network(make_trajectory):
    trajectory = make_trajectory()
    trajectory.check_fits(SPEC)
    with pytest.raises(MessageError, match=r"\[T\+1, 32, 32, 3\].*actor-01; actor and learner run"):
        trajectory.check_fits(NetworkSpec((32, 32, 3), 36, "plain", 1.0))
    with pytest.raises(MessageError, match="expected indices below 2; got"):
        trajectory.check_fits(NetworkSpec((84, 84, 3), 2, "plain", 1.0))


def test_steps_and_return(make_trajectory):
    rewards = np.array([1.0, 2.0, -0.5], np.float32)
    trajectory = dataclasses.replace(make_trajectory(), rewards=rewards)
    assert (trajectory.steps, trajectory.return_) == (3, 2.5)


def test_a_ticket_comes_exactly_with_collect():
    ticket = Ticket(0, 0, 0, 0, 0, 1, 0.0)
    TicketReply(Instruction.COLLECT, "n", 1, ticket)
    for instruction, given in ((Instruction.COLLECT, None), (Instruction.WAIT, ticket)):
        with pytest.raises(MessageError, match="one exactly with 'collect'"):
            TicketReply(instruction, "n", 1, given)


@pytest.mark.parametrize(
    "wrong", [{"index": -1}, {"seed": 2**63}, {"steps": 0}, {"epsilon": 1.1}, {"epsilon": -0.1}]
)
def test_a_ticket_out_of_range(wrong):
    (name,) = wrong
    with pytest.raises(MessageError, match=f"ticket.{name}"):
        dataclasses.replace(Ticket(0, 0, 0, 0, 0, 1, 0.0), **wrong)


def test_a_snapshot_whose_weights_were_changed():
    sound = Snapshot(1, 1, SPEC, b"weights", weights_digest(b"weights"))
    with pytest.raises(MessageError, match=r"snapshot\.digest"):
        dataclasses.replace(sound, weights=b"other")
    with pytest.raises(MessageError, match="64 hexadecimal digits"):
        dataclasses.replace(sound, digest="abc")


def test_ids_inside_messages_are_checked():
    with pytest.raises(MessageError, match=r"ticket_request\.nonce"):
        TicketRequest("a", "i", "no nonce")
    with pytest.raises(MessageError, match=r"trajectory_id\.sequence"):
        TrajectoryId("a", "i", -1)
    assert str(TrajectoryId("a", "i", 3)) == "a/i/3"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"observation_shape": (84, 84, 2)}, "grayscale or RGB"),
        ({"observation_shape": (0, 84, 3)}, "expected .height, width"),
        ({"n_actions": 1}, "n_actions: expected at least 2"),
        ({"beta": 0.0}, "beta: expected a finite positive"),
        ({"beta": float("nan")}, "beta"),
    ],
)
def test_a_network_that_cannot_be(changes, text):
    with pytest.raises(MessageError, match=text):
        dataclasses.replace(SPEC, **changes)
