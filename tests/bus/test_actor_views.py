"""What an actor shows: the first and the last picture of each episode, and few of those between."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from actors.rollout import Step
from actors.views import Views
from broker_config.keys import Kind
from broker_config.messages import Ticket, View
from tests.conftest import until_declared

TICKET = Ticket(3, 1, 0, 7, 5, 200, 0.0)


def step(number: int, channels: int = 3) -> Step:
    picture = np.random.default_rng(number).integers(0, 256, (84, 84, channels), np.uint8)
    return Step(number % 5, -0.5 * number, picture, False, False, False, None)


def play(views: Views, steps: int) -> None:
    views.show_start(TICKET, step(0).observation)
    for number in range(1, steps + 1):
        views.show_step(TICKET, number, step(number), is_last=number == steps)


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
    play(views, 50)
    play(views, 1)
    wait_until(lambda: len(heard) >= 4, "four views")
    assert [view.step for view in heard] == [0, 50, 0, 1]
    assert [view.sequence for view in heard] == [0, 1, 2, 3]
    assert [(view.ticket, view.attempt, view.policy_version) for view in heard] == [(3, 1, 5)] * 4
    assert [view.action for view in heard] == [None, 0, None, 1]
    assert [view.reward for view in heard] == [None, -25.0, None, -0.5]


def test_more_are_shown_when_there_is_time(attach: Any, wait_until: Callable[..., None]) -> None:
    heard = listen(attach)
    play(Views(attach("actor", "actor-0"), "actor-0", "life", pictures_per_sec=1e9), 20)
    wait_until(lambda: len(heard) >= 21, "all are shown")
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


def test_what_is_too_large_to_be_shown_does_not_stop_the_actor(
    attach: Any, caplog: pytest.LogCaptureFixture
) -> None:
    views = Views(attach("actor", "actor-0"), "actor-0", "life")
    noise = np.random.default_rng(0).integers(0, 256, (400, 400, 3), np.uint8)
    for _ in range(3):
        views.show_start(TICKET, noise)
    assert caplog.text.count("Views are not shown: View: expected at most") == 1
