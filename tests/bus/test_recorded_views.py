"""Real episodes, seen over the bus and recorded, read by programs that are not ours."""

from __future__ import annotations

import math
import os
import queue
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from actors.acting import UniformlyRandom
from actors.envs import make_env
from actors.robot.model import JOINT_NAMES, WITHDRAWN_POSE_RAD
from actors.rollout import Start, rollout
from actors.views import Views
from broker_config.bus import Bus, open_bus
from broker_config.keys import Kind
from broker_config.messages import Metrics, Role, Ticket, View
from broker_config.recording.recording import Recording
from broker_config.recording.segment import to_ns
from tests.conftest import RouterProcess, until_declared
from tests.viewers import Seen, seen

STEPS = 4
TICKET = Ticket(3, 0, 0, 7, 5, STEPS, 0.0)
EPISODES: dict[str, tuple[str, dict[str, Any]]] = {
    "flip": ("clothbus/HandkerchiefFlip36-v0", {"randomisation": "sim2real"}),
    "shirt": ("clothbus/ShirtFold-v0", {}),
    "robot": ("clothbus/HandkerchiefFold-v0", {"robot": True}),
    "reaching": ("clothbus/Reaching-v0", {}),
}


def play(views: Views, env_id: str, options: dict[str, Any]) -> Iterator[None]:
    """An episode of chance, all of which is shown; goes on when a view was heard."""
    env = make_env(env_id, horizon=STEPS, **options)
    chance = UniformlyRandom(int(env.action_space.n))  # type: ignore[attr-defined]
    number = 0
    for event in rollout(env, chance, TICKET):
        if isinstance(event, Start):
            views.show_start(TICKET, event.observation)
        else:
            number += 1
            views.show_step(TICKET, number, event, is_last=number == STEPS)
        yield
    env.close()


@pytest.fixture(scope="module")
def segment(router: RouterProcess, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of an episode of each task, with metrics."""
    folder = tmp_path_factory.mktemp("recording")
    heard: queue.Queue[View] = queue.Queue()
    with ExitStack() as stack, Recording(folder, "run", "rec-1") as recording:

        def attach(role: Role, name: str) -> Bus:
            return stack.enter_context(open_bus(router.address, "recorded-views", role, name))

        observer = attach("observer", "watching")
        observer.subscribe(observer.keys.every(Kind.VIEW), View, lambda _, view: heard.put(view))
        until_declared(observer)
        for actor, (env_id, options) in EPISODES.items():
            views = Views(attach("actor", actor), actor, "life", pictures_per_sec=1e9)
            for _ in play(views, env_id, options):
                view = heard.get(timeout=60)
                recording.add_view(view, to_ns(view.unix_secs))
        for number, loss in enumerate((0.5, math.nan, 0.25)):
            numbers = {"loss": loss, "steps": float(number)}
            recording.add_live(Metrics("owner", "learner", "life", number, number, numbers))
        recording.finish()
    (path,) = folder.glob("*.mcap")
    return path


@pytest.fixture(scope="module")
def topics(segment: Path) -> dict[str, list[Seen]]:
    found: dict[str, list[Seen]] = {}
    for item in seen(segment):
        found.setdefault(item.topic, []).append(item)
    return found


def test_pictures_decode_and_marks_lie_in_them(topics: dict[str, list[Seen]]) -> None:
    for actor in EPISODES:
        images, annotations = topics[f"view/{actor}/image"], topics[f"view/{actor}/annotations"]
        assert len(images) == len(annotations) == STEPS + 1
        for number, (image, drawn) in enumerate(zip(images, annotations, strict=True)):
            assert image.log_time_ns == drawn.log_time_ns
            picture = cv2.imdecode(np.frombuffer(image.value.data, np.uint8), cv2.IMREAD_COLOR)
            assert picture is not None
            height, width = picture.shape[:2]
            places = list(_places(drawn.value))
            assert all(0 <= x <= width and 0 <= y <= height for x, y in places)
            assert bool(places) == (number > 0 and actor != "reaching")
            (text,) = drawn.value.texts
            assert text.text.startswith(f"step {number}")


def _places(drawn: Any) -> Iterator[tuple[float, float]]:
    yield from ((it.position.x, it.position.y) for it in drawn.circles)
    yield from ((point.x, point.y) for line in drawn.points for point in line.points)


def test_a_hand_picks_where_cloth_was_and_a_fold_has_its_line(
    topics: dict[str, list[Seen]],
) -> None:
    pictures = [
        cv2.imdecode(np.frombuffer(it.value.data, np.uint8), cv2.IMREAD_COLOR)
        for it in topics["view/shirt/image"]
    ]
    table = pictures[0][0, 0].astype(int)
    for before, drawn in zip(pictures, topics["view/shirt/annotations"][1:], strict=False):
        hands = len(drawn.value.circles) // 2
        assert hands in (1, 2)
        assert len(drawn.value.points) == hands + 1
        for circle in drawn.value.circles[:hands]:
            pixel = before[int(circle.position.y), int(circle.position.x)].astype(int)
            assert np.abs(pixel - table).max() > 20, "nothing but the table"


def test_a_robot_s_joints_begin_and_end_withdrawn_and_move_between(
    topics: dict[str, list[Seen]],
) -> None:
    states = [item.value for item in topics["robot/robot/joints"]]
    assert [topic for topic in topics if topic.startswith("robot/")] == ["robot/robot/joints"]
    assert {tuple(state["name"]) for state in states} == {JOINT_NAMES}
    positions = np.array([state["position"] for state in states])
    for row in positions[[0, -1]]:
        np.testing.assert_allclose(row, WITHDRAWN_POSE_RAD, atol=1e-6)
    assert np.ptp(positions, axis=0).max() > 0.5
    stamps = [state["stamp"] for state in states]
    assert stamps == sorted(stamps), "a step's motion ends before the next begins"


def test_series_are_numbers(topics: dict[str, list[Seen]]) -> None:
    assert [it.value["data"] for it in topics["metrics/owner/learner/steps"]] == [[0], [1], [2]]
    ((first,), (second,), (third,)) = (
        it.value["data"] for it in topics["metrics/owner/learner/loss"]
    )
    assert (first, math.isnan(second), third) == (0.5, True, 0.25)
    for actor in EPISODES:
        assert len(topics[f"view/{actor}/reward"]) == STEPS


def test_ros_2_s_own_reading_is_the_same(segment: Path, topics: dict[str, list[Seen]]) -> None:
    decoders = pytest.importorskip(
        "mcap_ros2.decoder", reason="needs the extra: pip install 'clothbus[viewers]'"
    )
    with segment.open("rb") as file:
        reader = make_reader(file, decoder_factories=[decoders.DecoderFactory()])
        wanted = ["robot/robot/joints", "metrics/owner/learner/steps"]
        decoded = [(it[1].topic, it[3]) for it in reader.iter_decoded_messages(topics=wanted)]
    joints = [message for topic, message in decoded if topic == wanted[0]]
    for ours, theirs in zip(topics[wanted[0]], joints, strict=True):
        assert (theirs.name, theirs.position) == (ours.value["name"], ours.value["position"])
        assert (theirs.header.stamp.sec, theirs.header.stamp.nanosec) == ours.value["stamp"]
    steps = [list(message.data) for topic, message in decoded if topic == wanted[1]]
    assert steps == [[0], [1], [2]]


def test_rerun_s_converter_sees_pictures_and_series(segment: Path, tmp_path: Path) -> None:
    chunk = pytest.importorskip(
        "rerun.chunk", reason="needs the extra: pip install 'clothbus[viewers]'"
    )
    converted = tmp_path / "recording.rrd"
    command = [sys.executable, "-m", "rerun", "mcap", "convert", segment, "-o", converted]
    quiet = {**os.environ, "CI": "true"}  # else it reports its use to its makers
    done = subprocess.run(
        command, env=quiet, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    columns: dict[tuple[str, str], int] = {}
    for part in chunk.RrdReader(converted).stream():
        for name in part.to_record_batch().schema.names:
            key = part.entity_path.lstrip("/"), name
            columns[key] = columns.get(key, 0) + part.num_rows
    for actor in EPISODES:
        assert columns[f"view/{actor}/image", "EncodedImage:blob"] == STEPS + 1
        assert columns[f"view/{actor}/reward", "Scalars:scalars"] == STEPS
    assert columns["metrics/owner/learner/loss", "Scalars:scalars"] == 3
    assert columns["robot/robot/joints/position", "Scalars:scalars"] > STEPS
