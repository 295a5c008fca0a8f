"""The page of a run: its record, drawn and put into one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import jinja2
import numpy as np

from actors.policy import Policy
from broker_config.errors import StorageError
from broker_config.messages import Rewards
from deploy.evaluation.scores import modes_of
from deploy.report import tables
from deploy.report.composition import reward_parts
from deploy.report.figures import (
    draw_composition,
    draw_discriminators,
    draw_lags,
    draw_lives,
    draw_phases,
    draw_rates,
    draw_returns,
    draw_reward_map,
    draw_successes,
    draw_timeline,
)
from deploy.report.pictures import AttendedPicture, Strip, attended_pictures, film_strip
from deploy.report.record import RunRecord
from deploy.report.running import window_of
from deploy.report.svg import Svg
from deploy.report.tables import duration, moment
from deploy.reproduce.reward_maps import has_pose_grid, pose_grid, reward_maps
from discriminator.labelling import snapshot_of

TEMPLATE: Final = "page.html"


@dataclass(frozen=True)
class Tile:
    """A number that is worth a glance."""

    name: str
    value: str
    detail: str


@dataclass(frozen=True)
class Attention:
    """Grad-CAM of a policy."""

    version: int
    episode: int
    pictures: Sequence[AttendedPicture]


def render(
    record: RunRecord,
    policy: tuple[int, Policy] | None = None,
    missing: Sequence[str] = (),
) -> str:
    """The page as HTML.

    Args:
        record: Of the run; at least one episode of it is complete.
        policy: The newest that is there, and its version; None leaves Grad-CAM out.
        missing: What cannot be told, in words.

    Raises:
        StorageError: No episode is complete.
    """
    if not len(record.episodes):
        raise StorageError(
            f"run {record.name}: expected a complete episode to report on; got none among "
            f"{record.entries} journal entries; let the run go on"
        )
    schedule = record.preset.schedule
    learned = [schedule.episodes_before(it.version) for it in record.scores]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(TEMPLATE).render(
        record=record,
        preset=record.preset,
        head=_head(record),
        tiles=_tiles(record),
        missing=missing,
        figures=_figures(record),
        window=window_of(schedule.episodes_per_iteration, len(record.episodes)),
        iterations=tables.iteration_table(record.iterations),
        scores=tables.score_table(record.scores, learned),
        rewards=tables.reward_table(record.rewarded),
        strips=_strips(record),
        attention=_attention(record, policy),
        phases=tables.phase_table(record.iterations),
        phase_rows=tables.phase_rows(record.iterations),
        lives=tables.life_table(record),
        faults=tables.fault_table(record),
        attempts=tables.attempt_table(record),
        wrong=tables.wrong_table(record),
        orders=tables.order_table(record),
        settings=record.preset.to_json(),
    )


def _head(record: RunRecord) -> Mapping[str, str]:
    preset = record.preset
    head = {
        "preset": f"{preset.name} ({preset.source})",
        "task": f"{preset.task.environment}, {preset.task.horizon} steps at most",
        "method": preset.algorithm.method,
        "seed": f"{preset.seed}",
        "software": f"clothbus {', then '.join(record.software)}",
        "began": moment(record.first_secs),
        "lasted": duration(record.wall_secs),
        "journal": f"{record.entries} entries",
    }
    if record.demonstrations:
        head["demonstrations"] = f"{record.demonstrations}, {record.demonstrated_samples} samples"
    if record.followers:
        head["followers"] = ", ".join(record.followers)
    return head


def _tiles(record: RunRecord) -> list[Tile]:
    episodes, schedule = record.episodes, record.preset.schedule
    window = window_of(schedule.episodes_per_iteration, len(episodes))
    first, last = slice(0, window), slice(len(episodes) - window, None)
    samples = int(episodes.steps.sum())
    working_secs = max(record.wall_secs - record.away_secs, 1e-9)
    survived = tables.n_survived(record)
    tiles = [
        Tile("episodes", f"{len(episodes)}", f"of {schedule.episodes}, {samples} samples"),
        Tile(
            "return",
            f"{np.mean(episodes.returns[last]):.2f}",
            f"mean of the last {window}; {np.mean(episodes.returns[first]):.2f} at first",
        ),
        Tile(
            "success",
            f"{np.mean(episodes.successes[last]):.0%}",
            f"of the last {window}; {np.mean(episodes.successes[first]):.0%} at first",
        ),
    ]
    newest = [it for it in record.scores if it.episodes > 1]
    if newest:
        usual = modes_of(record.preset.algorithm)[0]
        last_score = max(newest, key=lambda it: (it.version, it.mode == usual))
        low, high = last_score.return_interval
        tiles.append(
            Tile(
                "evaluated",
                f"{last_score.mean_return:.2f}",
                f"{low:.2f} to {high:.2f}: version {last_score.version}, {last_score.mode}, "
                f"{last_score.episodes} episodes",
            )
        )
    tiles += [
        Tile("policy versions", f"{record.newest_version}", f"in {duration(record.wall_secs)}"),
        Tile("samples per second", f"{samples / working_secs:.1f}", "while the learner was there"),
        Tile("faults survived", f"{survived}", f"{record.repeated} episodes counted twice"),
    ]
    return tiles


def _figures(record: RunRecord) -> Mapping[str, Svg]:
    figures = {
        "returns": draw_returns(record),
        "successes": draw_successes(record),
        "lags": draw_lags(record),
        "lives": draw_lives(record),
    }
    if record.iterations:
        figures["rates"] = draw_rates(record.iterations)
        figures["phases"] = draw_phases(record.iterations)
    if record.rewarded:
        figures["composition"] = draw_composition(record.rewarded)
        figures["discriminators"] = draw_discriminators(record.rewarded)
    if record.newest_rewards is not None:
        figures |= _reward_figures(record, record.newest_rewards)
    return figures


def _reward_figures(record: RunRecord, rewards: Rewards) -> Mapping[str, Svg]:
    """What the newest discriminators reward: in the last episode, and over all poses of an arm."""
    preset, last = record.preset, record.shown["last"]
    states = np.concatenate([part.observations[1:] for part in last.parts])
    task = np.concatenate([part.rewards for part in last.parts])
    figures = {"timeline": draw_timeline(reward_parts(preset, rewards, states), task)}
    if has_pose_grid(preset):
        grid = pose_grid(preset)
        maps = reward_maps(preset, snapshot_of(rewards).weights, grid)
        figures["map"] = draw_reward_map(grid, maps["all"])
    return figures


def _strips(record: RunRecord) -> list[Strip]:
    return [
        film_strip(
            f"{name.capitalize()} episode: number {it.index + 1}, return {it.return_:.2f}, "
            f"{'success' if it.success else 'no success'} at the end",
            it,
        )
        for name, it in record.shown.items()
    ]


def _attention(record: RunRecord, policy: tuple[int, Policy] | None) -> Attention | None:
    if policy is None:
        return None
    version, network = policy
    last = record.shown["last"]
    pictures = attended_pictures(network, last.parts[0])
    return Attention(version, last.index + 1, pictures)
