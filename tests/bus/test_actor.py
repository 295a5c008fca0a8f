"""The actor's process on a real bus, in this process, against an owner made of a few handlers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from actors.service import Actor
from broker_config.bus import Bus
from broker_config.errors import AttachRefused, Refused
from broker_config.keys import Kind, ParsedKey
from broker_config.messages import (
    Ack,
    Attach,
    Instruction,
    Refusal,
    Snapshot,
    SnapshotRequest,
    Ticket,
    TicketReply,
    TicketRequest,
    Trajectory,
    Verdict,
    Welcome,
    weights_digest,
)
from broker_config.queries import Responder
from broker_config.spool import Spool
from deploy.presets import load_preset
from learner.trainer import Trainer

PRESET = load_preset("reaching-smoke")


class FakeOwner:
    """Issues tickets for the versions given to it, then stops; it can go silent."""

    def __init__(self, bus: Bus, versions: list[int]) -> None:
        self.trajectories: list[Trajectory] = []
        self.nonces: list[str] = []
        self.asked_versions: list[int] = []
        self.acks = threading.Event()
        self.acks.set()
        self.refuses_trajectories = False
        self.gone_versions: set[int] = set()
        self.given_back: list[tuple[int, int]] = []
        self._versions = versions
        self._issued: dict[str, Ticket] = {}
        bus.serve(bus.keys.every(Kind.ATTACH), Attach, self._attach)
        bus.serve(bus.keys.every(Kind.TICKET), TicketRequest, self._ticket)
        bus.serve(bus.keys.every(Kind.TRAJECTORY), Trajectory, self._take)
        bus.serve(bus.keys.every(Kind.POLICY_VERSION), SnapshotRequest, self._snapshot)

    @staticmethod
    def snapshot(version: int) -> Snapshot:
        weights = Trainer(load_preset("reaching-smoke", [f"seed={version}"])).weights_bytes()
        return Snapshot(version, 1, PRESET.network, weights, weights_digest(weights))

    def _attach(self, _: ParsedKey, request: Attach, to: Responder) -> None:
        if request.preset_digest not in ("", PRESET.digest):
            to.reply(Refusal("preset digest", PRESET.digest, request.preset_digest, "use ours"))
            return
        to.reply(Welcome("run", 1, PRESET.to_json()))

    def _ticket(self, _: ParsedKey, request: TicketRequest, to: Responder) -> None:
        self.nonces.append(request.nonce)
        if request.gives_back is not None:
            self.given_back.append(request.gives_back)
        index = len(self._issued)
        if request.nonce not in self._issued and index == len(self._versions):
            to.reply(TicketReply(Instruction.STOP, request.nonce, 1))
            return
        ticket = Ticket(index, 0, 0, index, self._versions[min(index, 2)], 10, 0.0)
        ticket = self._issued.setdefault(request.nonce, ticket)
        if self.nonces.count(request.nonce) == 1 and index == 1:
            to.drop()  # the answer is lost: the actor must ask with the same nonce again
            return
        to.reply(TicketReply(Instruction.COLLECT, request.nonce, 1, ticket))

    def _take(self, _: ParsedKey, trajectory: Trajectory, to: Responder) -> None:
        if not self.acks.is_set():
            to.drop()
            return
        if self.refuses_trajectories:
            to.reply(Refusal("trajectory", "another picture", "this one", "use one preset"))
            return
        self.trajectories.append(trajectory)
        offset = len(self.trajectories)
        to.reply(Ack(trajectory.id, 1, offset, Verdict.ACCEPTED, duplicate=False))

    def _snapshot(self, _: ParsedKey, request: SnapshotRequest, to: Responder) -> None:
        self.asked_versions.append(request.version)
        if request.version in self.gone_versions:
            to.reply(Refusal("policy version", "another", str(request.version), "ask again"))
            return
        to.reply(self.snapshot(request.version))


@pytest.fixture
def make_actor(attach: Any, tmp_path: Path) -> Iterator[Callable[..., Actor]]:
    with Spool(tmp_path / "spool.sqlite", "run", "actor-1", "life", 1 << 20) as spool:
        bus = attach("actor", "actor-1")
        yield lambda **options: Actor(bus, "actor-1", spool, "life", **options)


def test_an_actor_plays_exactly_the_versions_of_its_tickets_and_delivers_all(
    attach: Any, make_actor: Callable[..., Actor]
) -> None:
    bus = attach("owner", "learner")
    owner = FakeOwner(bus, [0, 3, 2])
    bus.latest_publisher(bus.keys.policy).put(owner.snapshot(3))
    make_actor().run()
    assert [it.ticket.policy_version for it in owner.trajectories] == [0, 3, 2]
    assert [it.ticket.index for it in owner.trajectories] == [0, 1, 2]
    assert set(owner.asked_versions) >= {0, 2}
    assert len({it.id for it in owner.trajectories}) == 3
    repeated = [nonce for nonce in owner.nonces if owner.nonces.count(nonce) > 1]
    assert len(set(repeated)) == 1, "the lost answer was asked for again, under the same nonce"


def test_a_full_spool_makes_a_simulator_wait_and_nothing_is_lost(
    attach: Any, tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    owner = FakeOwner(attach("owner", "learner"), [0, 0, 0])
    owner.acks.clear()
    one_episode = 11 * 84 * 84 + 5000
    limit = int(1.5 * one_episode)
    with Spool(tmp_path / "small.sqlite", "run", "actor-1", "life", limit) as spool:
        actor = Actor(attach("actor", "actor-1"), "actor-1", spool, "life")
        thread = threading.Thread(target=actor.run)
        thread.start()
        wait_until(lambda: actor.state == "spool full", "the second episode does not fit")
        assert owner.trajectories == []
        owner.acks.set()
        thread.join(60)
        assert not thread.is_alive()
    assert [it.ticket.index for it in owner.trajectories] == [0, 1, 2]


def test_another_preset_is_refused_in_words(attach: Any, make_actor: Callable[..., Actor]) -> None:
    FakeOwner(attach("owner", "learner"), [0])
    other = load_preset("reaching-smoke", ["seed=9"])
    with pytest.raises(AttachRefused, match=f"expected {PRESET.digest}; got {other.digest}"):
        make_actor(preset=other).run()


def test_an_actor_without_an_owner_can_be_stopped(make_actor: Callable[..., Actor]) -> None:
    actor = make_actor()
    thread = threading.Thread(target=actor.run)
    thread.start()
    actor.stop()
    thread.join(30)
    assert not thread.is_alive()


def test_a_refused_trajectory_ends_the_actor_with_the_reason_and_stays_in_the_spool(
    attach: Any, tmp_path: Path
) -> None:
    owner = FakeOwner(attach("owner", "learner"), [0] * 50)
    owner.refuses_trajectories = True
    with Spool(tmp_path / "spool.sqlite", "run", "actor-1", "life", 64 << 20) as spool:
        actor = Actor(attach("actor", "actor-1"), "actor-1", spool, "life")
        with pytest.raises(Refused, match="expected another picture; got this one"):
            actor.run()
        assert spool.status().trajectories >= 1


def test_a_ticket_whose_policy_is_gone_is_given_back(
    attach: Any, make_actor: Callable[..., Actor]
) -> None:
    owner = FakeOwner(attach("owner", "learner"), [0, 3, 2])
    owner.gone_versions = {3}
    make_actor().run()
    assert owner.given_back == [(1, 0)]
    assert [it.ticket.policy_version for it in owner.trajectories] == [0, 2]
