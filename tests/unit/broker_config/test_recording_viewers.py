"""What viewers find in a recording: pictures, marks in them, numbers, joints."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from broker_config.errors import MessageError
from broker_config.messages import JointMotion, Mark, Metrics, View
from broker_config.recording.recording import Recording
from tests.viewers import Seen, seen

MARKS = (
    Mark("fold_line", ((1.5, 2.0), (30.0, 2.5))),
    Mark("pick", ((4.5, 5.5),)),
    Mark("pick", ((20.5, 5.5),)),
    Mark("drop", ((4.0, 25.0),)),
    Mark("drop", ((21.0, 26.0),)),
)
MOTION = JointMotion(
    ("CHEST_JOINT0", "LARM_JOINT0", "RARM_JOINT05"),
    np.array([1.5, 0.25, 0.0], np.float32),
    np.arange(9, dtype=np.float32).reshape(3, 3) / 8,
)


def view(
    sequence: int = 1,
    unix_secs: float = 1.5e9,
    marks: tuple[Mark, ...] = MARKS,
    motion: JointMotion | None = MOTION,
) -> View:
    picture = b"picture", "png", unix_secs
    return View("actor-0", "life", sequence, 0, 0, 0, 3, 17, -0.523456, *picture, marks, motion)


def metrics(sequence: int, **numbers: float) -> Metrics:
    return Metrics("owner", "learner", "life", sequence, sequence, numbers)


def recorded(folder: Path, *messages: View | Metrics) -> dict[str, list[Seen]]:
    """What viewers see of them, by topic."""
    with Recording(folder, "run", "rec-1") as recording:
        for message in messages:
            recording.add_live(message)
        recording.finish()
    return by_topic(folder)


def by_topic(folder: Path) -> dict[str, list[Seen]]:
    found: dict[str, list[Seen]] = {}
    for path in sorted(folder.glob("*.mcap")):
        for item in seen(path):
            found.setdefault(item.topic, []).append(item)
    return found


def points(annotation: object) -> list[tuple[float, float]]:
    return [(point.x, point.y) for point in annotation.points]  # type: ignore[attr-defined]


def test_a_picture_and_its_marks_belong_together(tmp_path: Path) -> None:
    found = recorded(tmp_path, view(unix_secs=1_500_000_000.25))
    ((image,), (annotations,)) = (
        found[f"view/actor-0/{kind}"] for kind in ("image", "annotations")
    )
    assert (image.schema, annotations.schema) == (
        "foxglove.CompressedImage",
        "foxglove.ImageAnnotations",
    )
    assert (image.value.data, image.value.format) == (b"picture", "png")
    for item in (image, annotations):
        stamp = item.value.timestamp
        assert stamp.seconds * 10**9 + stamp.nanos == item.publish_time_ns
        assert item.publish_time_ns == pytest.approx(1_500_000_000_250_000_000, abs=1000)
    assert image.log_time_ns == annotations.log_time_ns


def test_hands_are_circles_and_ways_and_fold_lines_are_lines(tmp_path: Path) -> None:
    ((found,),) = (recorded(tmp_path, view())["view/actor-0/annotations"],)
    centres = [(it.position.x, it.position.y) for it in found.value.circles]
    assert centres == [(4.5, 5.5), (20.5, 5.5), (4.0, 25.0), (21.0, 26.0)]
    assert len({str(it.outline_color) for it in found.value.circles}) == 2
    assert [points(it) for it in found.value.points] == [
        [(4.5, 5.5), (4.0, 25.0)],
        [(20.5, 5.5), (21.0, 26.0)],
        [(1.5, 2.0), (30.0, 2.5)],
    ]
    assert [it.text for it in found.value.texts] == ["step 3: action 17, reward -0.523"]


def test_a_picture_without_marks_takes_away_those_of_the_last(tmp_path: Path) -> None:
    start = View("actor-0", "life", 0, 0, 0, 0, 0, None, None, b"picture", "png", 1.0)
    found = recorded(tmp_path, start, view(), view(2, marks=(), motion=None))
    first, marked, last = (item.value for item in found["view/actor-0/annotations"])
    assert [it.text for it in first.texts] == ["step 0"]
    assert (len(first.circles), len(marked.circles), len(last.circles)) == (0, 4, 0)
    assert (len(first.points), len(marked.points), len(last.points)) == (0, 3, 0)


def test_each_number_is_a_series_whatever_it_is_and_whenever_it_begins(tmp_path: Path) -> None:
    found = recorded(
        tmp_path,
        metrics(0, loss=0.5),
        metrics(1, loss=math.nan, steps=3.0),
        metrics(2, loss=math.inf),
        view(),
    )
    series = {
        topic: [item.value["data"] for item in items]
        for topic, items in found.items()
        if items[0].schema == "std_msgs/msg/Float64MultiArray"
    }
    assert series.keys() == {
        "metrics/owner/learner/loss",
        "metrics/owner/learner/steps",
        "view/actor-0/reward",
    }
    losses = [loss for (loss,) in series["metrics/owner/learner/loss"]]
    assert losses == [0.5, pytest.approx(math.nan, nan_ok=True), math.inf]
    assert series["metrics/owner/learner/steps"] == [[3.0]]
    assert series["view/actor-0/reward"] == [[-0.523456]]


def test_joints_are_where_they_were_before_the_picture(tmp_path: Path) -> None:
    found = recorded(tmp_path, view())
    (image,) = found["view/actor-0/image"]
    states = found["robot/actor-0/joints"]
    assert {item.schema for item in states} == {"sensor_msgs/msg/JointState"}
    assert [item.value["position"] for item in states] == MOTION.angles_rad.tolist()
    for state, secs_before in zip(states, MOTION.secs_before.tolist(), strict=True):
        assert state.value["name"] == list(MOTION.joints)
        assert (state.value["velocity"], state.value["effort"]) == ([], [])
        before_ns = round(secs_before * 1e9)
        assert state.publish_time_ns == image.publish_time_ns - before_ns
        assert state.log_time_ns == image.log_time_ns - before_ns
        secs, ns = state.value["stamp"]
        assert secs * 10**9 + ns == state.publish_time_ns


@pytest.mark.parametrize("unix_secs", [-1e300, -1.0, 0.0, 5e9, 1e300])
def test_a_clock_that_is_wrong_stops_no_recorder(tmp_path: Path, unix_secs: float) -> None:
    found = recorded(tmp_path, view(unix_secs=unix_secs))
    assert len(found["view/actor-0/image"]) == 1
    assert len(found["robot/actor-0/joints"]) == 3


def test_too_many_numbers_are_left_out_and_stop_no_recorder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("broker_config.recording.segment.MOST_CHANNELS", 5)
    many = [metrics(n, **{f"number {n}": 1.0, f"other {n}": 2.0}) for n in range(4)]
    found = recorded(tmp_path, *many)
    assert found.keys() == {
        "metrics/owner/learner/number 0",
        "metrics/owner/learner/other 0",
        "metrics/owner/learner/number 1",
    }
    assert caplog.text.count("viewers will miss 'metrics/owner/learner/other 1'") == 1


def test_what_viewers_see_survives_a_killed_recorder(tmp_path: Path) -> None:
    with Recording(tmp_path, "run", "rec-1") as recording:
        recording.add_live(view())
        recording.add_live(metrics(0, loss=0.5))
        recording.flush()
    with Recording(tmp_path, "run", "rec-2") as recording:
        recording.add_live(metrics(1, loss=0.25))
        recording.finish()
    found = by_topic(tmp_path)
    assert [it.value["data"] for it in found["metrics/owner/learner/loss"]] == [[0.5], [0.25]]
    assert len(found["robot/actor-0/joints"]) == 3
    assert len(found["view/actor-0/annotations"]) == 1


@pytest.mark.parametrize(
    ("kind", "points_px"),
    [("pick", ()), ("drop", ((1.0, 2.0), (3.0, 4.0))), ("fold_line", ((1.0, 2.0),))],
)
def test_a_mark_has_the_points_of_its_kind(kind: str, points_px: object) -> None:
    with pytest.raises(MessageError, match=r"mark\.points_px: expected [12] for a"):
        Mark(kind, points_px)  # type: ignore[arg-type]


def test_marks_and_motions_are_of_what_was_done() -> None:
    with pytest.raises(MessageError, match=r"mark\.points_px: expected finite numbers"):
        Mark("pick", ((math.nan, 1.0),))
    with pytest.raises(MessageError, match=r"view\.marks: expected no marks and no motion"):
        View("a", "life", 0, 0, 0, 0, 0, None, None, b"", "png", 1.0, MARKS)
    with pytest.raises(MessageError, match="expected a posture of a joint; got 1 of 0"):
        JointMotion((), np.zeros(1, np.float32), np.zeros((1, 0), np.float32))
    with pytest.raises(MessageError, match=r"secs_before: expected 0 or more; got \[-1\.0\]"):
        JointMotion(("a",), np.full(1, -1, np.float32), np.zeros((1, 1), np.float32))
    with pytest.raises(MessageError, match=r"angles_rad: expected float32 \[1, 2\]"):
        JointMotion(("a", "b"), np.zeros(1, np.float32), np.zeros((1, 1), np.float32))
