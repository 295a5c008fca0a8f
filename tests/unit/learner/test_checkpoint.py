import logging
import os
from pathlib import Path

import pytest
import safetensors.torch
import torch

from broker_config.errors import StorageError
from learner.checkpoint import CheckpointStore
from learner.trainer import TrainerState

STATE = TrainerState(
    {
        "network.weight": torch.randn(4, 3),
        "optimiser.step": torch.tensor(7.0),
        "memory.terminated": torch.tensor([True, False]),
        "memory.frames": torch.arange(24, dtype=torch.uint8).view(2, 3, 4),
        "memory.actions": torch.empty(0, dtype=torch.int64),
    },
    {"updates": 3, "gradient_steps": 12},
)
EXTRA = {"absorbed": 5, "tickets": [[1, "a"], None], "share": 0.1}


def state_number(n: int) -> TrainerState:
    return TrainerState({"weight": torch.full((3,), float(n))}, {"updates": n})


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_checkpoint_comes_back_bit_for_bit(tmp_path: Path) -> None:
    path = CheckpointStore(tmp_path).save(STATE, EXTRA)
    checkpoint = CheckpointStore(tmp_path).latest()
    assert checkpoint is not None
    assert checkpoint.path == path
    assert checkpoint.extra == EXTRA
    assert checkpoint.state.counters == STATE.counters
    assert checkpoint.state.tensors.keys() == STATE.tensors.keys()
    for name, tensor in STATE.tensors.items():
        back = checkpoint.state.tensors[name]
        assert back.dtype == tensor.dtype
        assert torch.equal(back, tensor)


def test_there_is_none_at_first(tmp_path: Path) -> None:
    assert CheckpointStore(tmp_path / "new").latest() is None


def test_keeps_the_newest_two(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path)
    for n in range(4):
        store.save(state_number(n), {})
    assert names(tmp_path) == ["checkpoint-00000002.safetensors", "checkpoint-00000003.safetensors"]
    latest = store.latest()
    assert latest is not None
    assert latest.state.counters == {"updates": 3}


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "header", "foreign"])
def test_a_damaged_newest_checkpoint_is_skipped(
    tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    store = CheckpointStore(tmp_path)
    store.save(state_number(1), {"n": 1})
    newest = store.save(state_number(2), {"n": 2})
    data = bytearray(newest.read_bytes())
    if damage == "truncated":
        data = data[:-1]
    elif damage == "flipped":
        data[-1] ^= 1
    elif damage == "empty":
        data = bytearray()
    elif damage == "header":
        data = data.replace(b'\\"updates\\": 2', b'\\"updates\\": 9')
    else:
        data = bytearray(safetensors.torch.save({"a": torch.zeros(1)}))
    assert data != newest.read_bytes()
    newest.write_bytes(data)
    with caplog.at_level(logging.WARNING):
        latest = store.latest()
    assert latest is not None
    assert latest.extra == {"n": 1}
    assert "Skipped a damaged checkpoint" in caplog.text
    assert newest.name in caplog.text


def test_a_new_checkpoint_never_takes_a_damaged_one_s_name(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path)
    store.save(state_number(1), {})
    store.save(state_number(2), {}).write_bytes(b"")
    store.save(state_number(3), {})
    latest = store.latest()
    assert latest is not None
    assert latest.state.counters == {"updates": 3}
    assert latest.path.name == "checkpoint-00000002.safetensors"


def test_nothing_but_damaged_ones_is_an_error_not_a_fresh_start(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path)
    store.save(state_number(1), {}).write_bytes(b"garbage")
    with pytest.raises(StorageError, match="1 damaged; move them away"):
        store.latest()


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_crash_while_writing_leaves_the_earlier_ones(
    tmp_path: Path, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = CheckpointStore(tmp_path)
    store.save(state_number(1), {})

    def crash(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os if step == "fsync" else Path, step, crash)
        with pytest.raises(StorageError, match="No space left on device; free disk"):
            store.save(state_number(2), {})
    latest = store.latest()
    assert latest is not None
    assert latest.state.counters == {"updates": 1}
    store.save(state_number(3), {})
    assert names(tmp_path) == ["checkpoint-00000000.safetensors", "checkpoint-00000001.safetensors"]


def test_refuses_what_json_would_change(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path)
    for extra in ({"pair": (1, 2)}, {"by": {1: 2}}, {"bytes": b""}, {"nan": float("nan")}):
        with pytest.raises(StorageError, match="expected what JSON"):
            store.save(STATE, extra)
    assert names(tmp_path) == []


def test_refuses_a_folder_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="expected a folder"):
        CheckpointStore(tmp_path / "file")
    with pytest.raises(StorageError, match="expected at least 1; got 0"):
        CheckpointStore(tmp_path, keep=0)
