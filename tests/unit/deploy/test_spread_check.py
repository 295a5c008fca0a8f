from pathlib import Path

import pytest
from PIL import Image

from broker_config.errors import PresetError
from deploy.commands.tasks import spread
from deploy.tasks import spread_check


def test_folded_handkerchiefs_come_back_and_leave_a_film_strip(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    strip = tmp_path / "new" / "strip.png"
    spread(episodes=2, states=("folded_over",), film_strip=strip)
    printed = capsys.readouterr().out
    assert "folded_over" in printed
    assert "spread 2" in printed
    with Image.open(strip) as picture:
        assert picture.size[0] == spread_check.STRIP_COLUMNS * spread_check.TILE_PX


def test_too_few_that_come_back_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spread_check, "SPREAD_COVERAGE", 1.1)
    with pytest.raises(SystemExit) as end:
        spread(episodes=1, states=("creased",))
    assert end.value.code == 1


def test_what_cannot_be_spread_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PresetError, match="--size-px: expected at least 32; got 8"):
        spread(size_px=8)
    with pytest.raises(PresetError, match="--states: expected at least one; got none"):
        spread(states=())
    with pytest.raises(PresetError, match=r"initial_state: expected one of .* got 'rolled'"):
        spread(states=("rolled",))
    with pytest.raises(PresetError, match="expected a task with a handkerchief"):
        spread("TrousersFold", episodes=1)
    with pytest.raises(PresetError, match="expected some of the arguments"):
        spread("Reaching", episodes=1)
    with pytest.raises(PresetError, match=r"film strip: expected a file that ends in \.png"):
        spread(episodes=1, states=("creased",), film_strip=tmp_path / "strip.gif")
