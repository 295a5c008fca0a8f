"""Where everything of one run lies on disk."""

from __future__ import annotations

import datetime
import re
from dataclasses import dataclass
from pathlib import Path

from broker_config.errors import PresetError, StorageError
from broker_config.preset import Preset, preset_from_json

_NOT_IN_AN_ID = re.compile(r"[^a-z0-9_-]+")


@dataclass(frozen=True)
class RunFolder:
    """The files of a run; its name is the run's name on the bus."""

    path: Path

    @property
    def run(self) -> str:
        """The run's name, usable as a key."""
        return _NOT_IN_AN_ID.sub("-", self.path.resolve().name.lower())[:64]

    @property
    def preset_file(self) -> Path:
        """The whole configuration, as JSON."""
        return self.path / "preset.json"

    @property
    def journal(self) -> Path:
        """The record of the run."""
        return self.path / "journal.sqlite"

    @property
    def checkpoints(self) -> Path:
        """What the learner resumes from."""
        return self.path / "checkpoints"

    @property
    def snapshots(self) -> Path:
        """Policies by version."""
        return self.path / "snapshots"

    @property
    def tensorboard(self) -> Path:
        """For `tensorboard --logdir`."""
        return self.path / "tensorboard"

    @property
    def curve(self) -> Path:
        """The learning curve."""
        return self.path / "learning_curve.png"

    @property
    def film_strip(self) -> Path:
        """The last episode, picture by picture."""
        return self.path / "film_strip.png"

    @property
    def recording(self) -> Path:
        """The recorder's copy of the journal and of the live traffic, as MCAP."""
        return self.path / "recording"

    @property
    def offline(self) -> Path:
        """What the run learns from, if it does not act: recordings."""
        return self.path / "offline.json"

    @property
    def compute(self) -> Path:
        """On what and by which path the run is trained, in words."""
        return self.path / "compute.txt"

    @property
    def router_address(self) -> Path:
        """Where the embedded router of the run listens."""
        return self.path / "router.address"

    @property
    def summary(self) -> Path:
        """The one-screen summary that `run` prints at its end."""
        return self.path / "summary.txt"

    @property
    def evaluation(self) -> Path:
        """Every episode that an evaluation has played, live or afterwards."""
        return self.path / "evaluation.jsonl"

    def stored_evaluation(self, states_digest: str) -> Path:
        """Every episode that began with stored states of this digest."""
        return self.path / f"evaluation-{states_digest[:12]}.jsonl"

    @property
    def evaluation_tensorboard(self) -> Path:
        """The evaluator's part of the TensorBoard logs."""
        return self.tensorboard / "evaluation"

    def log(self, process: str) -> Path:
        """What a process wrote to its standard output and error."""
        return self.path / "logs" / f"{process}.log"

    def spool(self, actor: str) -> Path:
        """An actor's trajectories that wait for their ack."""
        return self.path / "spools" / f"{actor}.sqlite"

    def read_preset(self) -> Preset:
        """The run's preset.

        Raises:
            StorageError: This is no run folder.
        """
        try:
            return preset_from_json(self.preset_file.read_text())
        except OSError as error:
            raise StorageError(
                f"{self.path}: expected a run folder with preset.json; got none; "
                "name a folder that `clothbus run` made"
            ) from error


def require_acting(folder: RunFolder) -> None:
    """Refuses to go on by acting with what has learned from recordings.

    Raises:
        PresetError: The folder's run learns from recordings.
    """
    if folder.offline.exists():
        raise PresetError(
            f"{folder.path}: expected a run that acts; got one that learns from recordings; go on "
            f"with `clothbus train --from SOURCES --output {folder.path}`"
        )


def router_address(connect: str) -> str:
    """An address as it is, or the one that a run folder holds in a file."""
    file = RunFolder(Path(connect)).router_address
    return file.read_text().strip() if file.is_file() else connect


def create_run_folder(runs: Path, preset: Preset) -> RunFolder:
    """Makes a new folder under `runs`, named after the preset and the time."""
    stamp = datetime.datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    for suffix in ["", *(f"-{n}" for n in range(2, 100))]:
        path = runs / f"{preset.name}-{stamp}{suffix}"
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise _unusable(path, error) from error
        return prepare_run_folder(path, preset)
    raise StorageError(f"{runs}: expected room for a new run at {stamp}; choose another --runs")


def prepare_run_folder(path: Path, preset: Preset) -> RunFolder:
    """Makes `path` a run folder of the preset, or checks that it is one already.

    Raises:
        StorageError: It is a folder of another preset's run.
    """
    folder = RunFolder(path)
    if not folder.preset_file.exists():
        try:
            (path / "logs").mkdir(parents=True, exist_ok=True)
            (path / "spools").mkdir(exist_ok=True)
            partial = folder.preset_file.with_suffix(".partial")
            partial.write_text(preset.to_json())
            partial.replace(folder.preset_file)
        except OSError as error:
            raise _unusable(path, error) from error
    elif (existing := folder.read_preset()).digest != preset.digest:
        raise StorageError(
            f"{path}: expected a run of preset {preset.name} ({preset.digest[:12]}); got one of "
            f"{existing.name} ({existing.digest[:12]}); resume it without a preset of your own"
        )
    return folder


def _unusable(path: Path, error: OSError) -> StorageError:
    return StorageError(
        f"run folder {path}: expected a place that can be written; got {error}; "
        "choose another with --runs"
    )
