"""The discriminator service on a real bus, in this process, beside a real learner."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
import torch

from actors.task import make_task_env
from broker_config.bus import Bus
from broker_config.errors import AttachRefused, PresetError
from broker_config.heart import Pulse
from broker_config.journal import Journal
from broker_config.messages import (
    DiscriminatorSnapshot,
    Role,
)
from broker_config.preset import Preset
from deploy.demonstrations.demonstrators import by_script
from deploy.demonstrations.making import make_demonstrations
from deploy.presets import load_preset
from deploy.running.in_process import InProcessActor
from discriminator.service import DiscriminatorService
from learner.checkpoint import CheckpointStore
from learner.learning import LearningLoop
from learner.metrics import LearningMetrics
from learner.owner import Owner
from learner.service import LearnerService
from learner.snapshots import SnapshotStore
from learner.trainer import Trainer

torch.set_num_threads(1)

Attach = Callable[[Role, str], Bus]
WaitUntil = Callable[..., None]
PRESET = load_preset("imitation-smoke", ["schedule.iterations=2"])


class Background:
    """Something that runs on a thread of its own."""

    def __init__(self, run: Callable[[], object]) -> None:
        self._run = run
        self.outcome: object = None
        self._thread = threading.Thread(target=self._keep_outcome)
        self._thread.start()

    def _keep_outcome(self) -> None:
        try:
            self.outcome = self._run()
        except Exception as error:
            self.outcome = error

    def join(self) -> object:
        self._thread.join(90)
        assert not self._thread.is_alive()
        return self.outcome


class Learner:
    """A learner that plays its episodes itself, once it is let go on."""

    def __init__(self, folder: Path, preset: Preset, attach: Attach, stack: ExitStack) -> None:
        journal = stack.enter_context(Journal(folder / "journal.sqlite"))
        env = stack.enter_context(closing(make_task_env(preset.task)))
        metrics = stack.enter_context(LearningMetrics(folder / "tensorboard"))
        self.go_on = threading.Event()
        self.owner = Owner("run", preset, journal)
        snapshots = SnapshotStore(folder / "snapshots")
        actor = InProcessActor(self.owner, env, snapshots)
        demonstrations = (
            make_demonstrations(preset, folder / "demos", 3, by_script(preset, 0.0))
            if preset.imitation
            else None
        )

        def wait_ready(index: int) -> bool:
            return self.go_on.wait(0.1) and actor.play_until_ready(index)

        loop = LearningLoop(
            self.owner,
            Trainer(preset),
            CheckpointStore(folder / "checkpoints"),
            snapshots,
            demonstrations,
            wait_ready,
        )
        bus, bulk_bus = attach("owner", "learner"), attach("owner", "learner")
        service = LearnerService(
            bus, bulk_bus, "learner", self.owner, loop, journal, snapshots, metrics, Pulse()
        )
        self.background = Background(service.run)
        stack.callback(self._end)

    def _end(self) -> None:
        self.owner.stop()
        self.background.join()


Begin = Callable[[Preset], Learner]


@pytest.fixture
def begin(tmp_path: Path, attach: Attach) -> Iterator[Begin]:
    with ExitStack() as stack:
        yield lambda preset: Learner(tmp_path, preset, attach, stack)


def wait_served(bus: Bus, learner: Learner, wait_until: WaitUntil) -> None:
    def is_served() -> bool:
        assert learner.background.outcome is None, learner.background.outcome
        return any(key.role == "owner" for key in bus.alive())

    wait_until(is_served, "the learner is there")


def begin_following(
    bus: Bus, name: str, learner: Learner, wait_until: WaitUntil
) -> tuple[DiscriminatorService, Background]:
    wait_served(bus, learner, wait_until)
    service = DiscriminatorService(bus, name, "life")
    running = Background(service.run)
    wait_until(lambda: service.state == "following", f"{name} follows")
    return service, running


@pytest.mark.timeout(150)
def test_a_run_has_one_service_and_whoever_looks_has_the_newest_discriminators(
    begin: Begin, attach: Attach, wait_until: WaitUntil
) -> None:
    learner = begin(PRESET)
    bus = attach("discriminator", "first")
    _, running = begin_following(bus, "first", learner, wait_until)

    second = DiscriminatorService(attach("discriminator", "second"), "second", "life")
    with pytest.raises(AttachRefused, match="no other discriminator service in the run; got first"):
        second.run()

    reader = attach("observer", "viewer").latest_reader(bus.keys.discriminators, NEWEST)
    learner.go_on.set()
    assert running.join() is True
    assert learner.background.join() is None

    def has_last() -> bool:
        newest = reader.get()
        return newest is not None and newest.iteration == 1

    wait_until(has_last, "the viewer has the last discriminators")


NEWEST = DiscriminatorSnapshot


@pytest.mark.timeout(100)
def test_it_needs_a_run_that_imitates(begin: Begin, attach: Attach, wait_until: WaitUntil) -> None:
    learner = begin(load_preset("reaching-smoke"))
    bus = attach("discriminator", "d")
    wait_served(bus, learner, wait_until)
    with pytest.raises(PresetError, match=r"expected a run with an \[imitation\] table"):
        DiscriminatorService(bus, "d", "life").run()


@pytest.mark.timeout(100)
def test_it_leaves_when_the_run_is_stopped(
    begin: Begin, attach: Attach, wait_until: WaitUntil
) -> None:
    learner = begin(PRESET)
    bus = attach("discriminator", "d")
    _, running = begin_following(bus, "d", learner, wait_until)
    learner.owner.stop()
    assert running.join() is True
    assert learner.background.join() is None


@pytest.mark.timeout(100)
def test_it_waits_for_its_owner_and_leaves_when_asked_to(
    attach: Attach, wait_until: WaitUntil
) -> None:
    service = DiscriminatorService(attach("discriminator", "d"), "d", "life")
    running = Background(service.run)
    wait_until(lambda: service.state == "waiting for the owner", "it says what it waits for")
    service.stop()
    assert running.join() is False


@pytest.mark.timeout(100)
def test_it_reads_the_journal_and_holds_no_policies_back(
    begin: Begin, attach: Attach, wait_until: WaitUntil
) -> None:
    learner = begin(PRESET)
    bus = attach("discriminator", "d")
    service, running = begin_following(bus, "d", learner, wait_until)
    assert not learner.owner.followers.is_known("d")
    service.stop()
    assert running.join() is False
