"""Demonstrators of a chosen quality."""

from __future__ import annotations

import pytest

from broker_config.errors import PresetError
from deploy.demonstrations.quality import TOLERANCE, find_quality
from deploy.presets import load_preset

TASK = load_preset("reaching-smoke").task


def test_more_mistakes_are_made_where_less_is_wanted() -> None:
    tried: dict[float, float] = {}
    rates = []
    for wanted in (1.0, 0.7, 0.3, 0.0):
        found = find_quality(TASK, wanted, 20, on_measured=tried.__setitem__)
        assert found.quality is not None
        assert found.quality.measured == pytest.approx(wanted, abs=TOLERANCE + 0.03)
        rates.append(found.mistake_rate)
    assert rates == sorted(rates)
    assert (rates[0], rates[-1]) == (0.0, 1.0)
    assert all(0.0 < rate < 1.0 for rate in tried)


def test_processes_do_not_change_what_is_found() -> None:
    assert find_quality(TASK, 0.5, 6, jobs=2) == find_quality(TASK, 0.5, 6)


def test_what_is_no_quality_is_refused() -> None:
    with pytest.raises(PresetError, match=r"expected 0 \(chance\) to 1 \(the script\); got 1\.5"):
        find_quality(TASK, 1.5, 2)
    with pytest.raises(PresetError, match="quality_episodes: expected at least 1; got 0"):
        find_quality(TASK, 0.5, 0)
    with pytest.raises(PresetError, match="jobs: expected at least 1; got 0"):
        find_quality(TASK, 0.5, 2, jobs=0)
