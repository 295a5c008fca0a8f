"""What demonstrations hold, for a person: a table, and all states on one contact sheet."""

from __future__ import annotations

import io
import itertools
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from rich.table import Table

from broker_config.durable import write_durably
from broker_config.errors import PresetError, StorageError
from broker_config.messages import Trajectory
from broker_config.preset import preset_from_json
from discriminator.targets import target_rule, target_states
from learner.recorded import Demonstrations

_LEAST_TILE_PX: Final = 84
"""Smaller pictures are enlarged by a whole number."""
_FEW_COLUMNS: Final = 10
"""With no more, pictures are shown twice as large."""
_GAP_PX, _CAPTION_PX, _NAME_PX = 8, 13, 84
_FRAME_PX: Final = 3
_PAPER, _INK, _TARGET = (255, 255, 255), (60, 60, 60), (225, 90, 0)


class Targets:
    """Which states of demonstrations are targets, and by what.

    Attributes:
        rule: In words.
        reached: For each demonstration, bool[T]: the state after each step.
    """

    def __init__(self, demonstrations: Demonstrations) -> None:
        """Judges them by a person's marks, or by their preset's rule."""
        origin = demonstrations.origin
        imitation = preset_from_json(origin.preset_json).imitation if origin else None
        target_reward = imitation.target_reward if imitation else None
        marks = demonstrations.marks
        self.rule = target_rule(target_reward, marks)
        self.reached = target_states(demonstrations.trajectories, target_reward, marks)

    @property
    def count(self) -> int:
        """In all demonstrations."""
        return sum(int(each.sum()) for each in self.reached)


def demonstration_table(demonstrations: Demonstrations, targets: Targets) -> Table:
    """A line for each episode."""
    table = Table("episode", "steps", "return", "success", f"targets ({targets.rule})")
    for number, (each, reached) in enumerate(
        zip(demonstrations.trajectories, targets.reached, strict=True)
    ):
        success = "yes" if each.success else "no"
        table.add_row(
            str(number), str(each.steps), f"{each.return_:.2f}", success, _as_ranges(reached)
        )
    return table


def _as_ranges(reached: NDArray[np.bool_]) -> str:
    """State indices as `label` takes them, such as 3,28-30."""
    states = (np.flatnonzero(reached) + 1).tolist()
    runs = itertools.groupby(enumerate(states), key=lambda item: item[1] - item[0])
    ends = [(run[0][1], run[-1][1]) for _, group in runs if (run := list(group))]
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in ends)


def draw_contact_sheet(path: Path, demonstrations: Demonstrations, targets: Targets) -> None:
    """Writes a PNG: a row for each episode, its states with their indices, targets framed.

    Args:
        path: Ends in .png; it is replaced.
        demonstrations: At least one.
        targets: Of them.

    Raises:
        PresetError: Another ending, or no demonstrations.
        StorageError: The file cannot be written.
    """
    if path.suffix != ".png" or not demonstrations.trajectories:
        raise PresetError(
            f"{path}: expected a file that ends in .png, and demonstrations to draw; got "
            f"{path.suffix or 'no ending'} and {len(demonstrations.trajectories)} episodes"
        )
    sheet = _contact_sheet(demonstrations.trajectories, targets)
    encoded = io.BytesIO()
    sheet.save(encoded, "PNG")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, encoded.getvalue())
    except OSError as error:
        raise StorageError(f"{path}: {error}; choose a place that can be written") from error


def _contact_sheet(trajectories: tuple[Trajectory, ...], targets: Targets) -> Image.Image:
    columns = max(each.steps for each in trajectories) + 1
    height_px, width_px = trajectories[0].observations.shape[1:3]
    scale = -(-_LEAST_TILE_PX // min(height_px, width_px)) * (2 if columns <= _FEW_COLUMNS else 1)
    tile_px = (width_px * scale, height_px * scale)
    cell_px = (tile_px[0] + _GAP_PX, tile_px[1] + _CAPTION_PX + _GAP_PX)
    size_px = (_NAME_PX + columns * cell_px[0], _GAP_PX + len(trajectories) * cell_px[1])
    sheet = Image.new("RGB", size_px, _PAPER)
    draw = ImageDraw.Draw(sheet)
    for row, (each, reached) in enumerate(zip(trajectories, targets.reached, strict=True)):
        top = _GAP_PX + row * cell_px[1]
        draw.multiline_text((_GAP_PX, top + _CAPTION_PX), _row_name(row, each), _INK)
        for state, observation in enumerate(each.observations):
            is_target = state > 0 and bool(reached[state - 1])
            left, picture_top = _NAME_PX + state * cell_px[0], top + _CAPTION_PX
            ink = _TARGET if is_target else _INK
            draw.text((left, top - 2), str(state), ink)
            if is_target:
                right, bottom = left + tile_px[0], picture_top + tile_px[1]
                frame = (left - _FRAME_PX, picture_top - _FRAME_PX,
                         right + _FRAME_PX - 1, bottom + _FRAME_PX - 1)  # fmt: skip
                draw.rectangle(frame, fill=_TARGET)
            sheet.paste(_tile(observation, tile_px), (left, picture_top))
    return sheet


def _row_name(number: int, trajectory: Trajectory) -> str:
    outcome = "success" if trajectory.success else "no success"
    return f"episode {number}\nreturn {trajectory.return_:.2f}\n{outcome}"


def _tile(observation: NDArray[np.uint8], size_px: tuple[int, int]) -> Image.Image:
    rgb = np.broadcast_to(observation, (*observation.shape[:2], 3))
    return Image.fromarray(np.ascontiguousarray(rgb)).resize(size_px, Image.Resampling.NEAREST)
