"""What an actor shows: the first and the last picture of each episode, and few of those between."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from actors.robot.motion import JointPath
from actors.rollout import Step
from actors.views import Views
from broker_config.keys import Kind
from broker_config.messages import Mark, Ticket, View
from tests.conftest import until_declared

TICKET = Ticket(3, 1, 0, 7, 5, 200, 0.0)


def step(number: int, channels: int = 3) -> Step:
    picture = np.random.default_rng(number).integers(0, 256, (84, 84, channels), np.uint8)
    return Step(number % 5, -0.5 * number, picture, False, False, False, None)


def play(views: Views, steps: int, has_shown: Callable[[int], None] = lambda _: None) -> None:
    """Shows an episode; `has_shown` is told each step, 0 before the first."""
    views.show_start(TICKET, step(0).observation)
    has_shown(0)
    for number in range(1, steps + 1):
        views.show_step(TICKET, number, step(number), is_last=number == steps)
        has_shown(number)


def is_heard(
    heard: list[View], wait_until: Callable[..., None], steps: Sequence[int]
) -> Callable[[int], None]:
    """Waits for each of these steps: views are best effort, and some of a burst may be dropped."""

    def has_shown(step: int) -> None:
        if step in steps:
            wait_until(lambda: heard and heard[-1].step == step, f"step {step} is heard")

    return has_shown


def listen(attach: Any) -> list[View]:
    heard: list[View] = []
    observer = attach("observer", "watching")
    observer.subscribe(observer.keys.every(Kind.VIEW), View, lambda _, view: heard.append(view))
    until_declared(observer)
    return heard


def test_first_and_last_are_always_shown_and_few_between(
    attach: Any, wait_until: Callable[..., None]
) -> None:
    heard = listen(attach)
    views = Views(attach("actor", "actor-0"), "actor-0", "life", pictures_per_sec=1e-3)
    for steps in (50, 1):
        play(views, steps, is_heard(heard, wait_until, (0, steps)))
    assert [view.step for view in heard] == [0, 50, 0, 1]
    assert [view.sequence for view in heard] == [0, 1, 2, 3]
    assert [(view.ticket, view.attempt, view.policy_version) for view in heard] == [(3, 1, 5)] * 4
    assert [view.action for view in heard] == [None, 0, None, 1]
    assert [view.reward for view in heard] == [None, -25.0, None, -0.5]


def test_more_are_shown_when_there_is_time(attach: Any, wait_until: Callable[..., None]) -> None:
    heard = listen(attach)
    views = Views(attach("actor", "actor-0"), "actor-0", "life", pictures_per_sec=1e9)
    play(views, 20, is_heard(heard, wait_until, range(21)))
    assert [view.step for view in heard] == list(range(21))


@pytest.mark.parametrize("channels", [1, 3])
def test_a_picture_is_what_was_seen(
    attach: Any, wait_until: Callable[..., None], channels: int
) -> None:
    heard = listen(attach)
    seen = step(0, channels).observation
    Views(attach("actor", "actor-0"), "actor-0", "life").show_start(TICKET, seen)
    wait_until(lambda: heard, "a view")
    flag = cv2.IMREAD_COLOR if channels == 3 else cv2.IMREAD_GRAYSCALE
    shown = cv2.imdecode(np.frombuffer(heard[0].picture, np.uint8), flag)
    assert shown is not None
    shown = cv2.cvtColor(shown, cv2.COLOR_BGR2RGB) if channels == 3 else shown[..., None]
    assert np.array_equal(shown, seen)


@pytest.mark.parametrize("lasted_secs", [1e-6, 1e6])
def test_a_motion_ends_with_its_picture_and_took_no_longer_than_its_step(
    attach: Any, wait_until: Callable[..., None], lasted_secs: float
) -> None:
    heard = listen(attach)
    views = Views(attach("actor", "actor-0"), "actor-0", "life")
    times = np.array([0.0, 0.25, 1.0]) * lasted_secs
    path = JointPath(("A", "B"), times, np.arange(6.0).reshape(3, 2))
    began_secs = time.monotonic()
    views.show_start(TICKET, step(0).observation)
    wait_until(lambda: heard, "the first picture")
    moved = replace(step(1), motion=path, marks=(Mark("pick", ((1.0, 2.0),)),))
    views.show_step(TICKET, 1, moved, is_last=True)
    took_secs = time.monotonic() - began_secs
    wait_until(lambda: len(heard) == 2, "the second picture")
    motion = heard[1].motion
    assert motion is not None
    assert (motion.joints, motion.angles_rad.tolist()) == (("A", "B"), path.joints_rad.tolist())
    first, second, last = motion.secs_before.tolist()
    assert first <= min(took_secs, lasted_secs) * (1 + 1e-6)
    assert (second, last) == (pytest.approx(0.75 * first), 0.0)
    assert lasted_secs > 1 or first == pytest.approx(lasted_secs)
    assert heard[1].marks == moved.marks


def test_what_is_too_large_to_be_shown_does_not_stop_the_actor(
    attach: Any, caplog: pytest.LogCaptureFixture
) -> None:
    views = Views(attach("actor", "actor-0"), "actor-0", "life")
    noise = np.random.default_rng(0).integers(0, 256, (400, 400, 3), np.uint8)
    for _ in range(3):
        views.show_start(TICKET, noise)
    assert caplog.text.count("Views are not shown: View: expected at most") == 1
