"""Maps of rewards over the poses of an arm, and the page that shows them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from actors.envs.planar_arm import end_effector_m
from actors.task import make_task_env
from broker_config.errors import PresetError, StorageError
from deploy.presets import load_preset
from deploy.reproduce.chapter4 import BID, PGAIL
from deploy.reproduce.command import PAGE, draw
from deploy.reproduce.experiment import Experiment, Panel
from deploy.reproduce.in_process_run import InProcessRun
from deploy.reproduce.kept_weights import kept_discriminators, kept_policy
from deploy.reproduce.reward_map_section import (
    MAP_SCORES,
    MAPS,
    NUMBERS,
    TIMELINE,
    map_rewards,
)
from deploy.reproduce.reward_maps import best_pose_degrees, pose_grid, reward_maps, score_map
from deploy.reproduce.runs import FinishedRun
from deploy.rewards.timeline import play_greedily, score_steps
from discriminator.stored import StoredDiscriminators

torch.set_num_threads(1)
MAPPED = Experiment(
    name="mapped",
    title="A short imitation with maps",
    source="figure 0",
    published="It is highest somewhere.",
    preset="reaching-ch4-horizon30",
    panels=(Panel("2 joints", (BID, PGAIL), seeds=1, mistake_rate=0.1),),
    overrides=(
        "task.options.n_joints=2",
        "task.n_actions=10",
        "schedule.iterations=2",
        "schedule.episodes_per_iteration=1",
        "schedule.target_switches=1",
        "schedule.epochs=1",
        "imitation.generator_epochs=1",
        "imitation.demonstration_samples=40",
        "imitation.discriminator_epochs=1",
        "imitation.discriminator.minibatch_size=16",
        "imitation.target_reward=-0.5",
    ),
    has_reward_maps=True,
)
PLAN = MAPPED.plan(MAPPED.panels[0], BID, 0)
GRID = pose_grid(PLAN.preset, 30.0)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[FinishedRun]]:
    """The work folder of both finished runs."""
    work, runs = tmp_path_factory.mktemp("work"), []
    for plan in MAPPED.plans():
        with InProcessRun(plan, work) as run:
            runs.append(FinishedRun(plan.key, "x", tuple(run.finish())))
            run.keep_policy()
    return work, runs


def test_the_grid_shows_poses_as_the_task_does() -> None:
    env = make_task_env(PLAN.preset.task)
    upright, _ = env.reset(seed=0)
    assert (GRID.pictures[0].numpy() == upright).all()
    for _ in range(30):  # 30 * 5.01 degrees: the largest increment of the second joint
        turned, reward, *_, info = env.step(9)
    env.close()
    angles_rad = info["joint_angles_rad"]
    grid = replace(GRID, degrees=np.rad2deg(angles_rad))
    assert (grid.pictures[1].numpy() == turned).all()
    assert grid.true_rewards[0, 1] == pytest.approx(reward)
    assert grid.reachable.tolist() == [[True, True], [True, False]]
    assert GRID.degrees.tolist() == [0, 30, 60, 90, 120, 150]
    assert GRID.reachable.sum() == 6 + 5 + 4 + 3 + 2 + 1
    assert GRID.pictures.shape == (36, 84, 84, 3)


def test_the_best_pose_is_on_the_target() -> None:
    assert best_pose_degrees() == pytest.approx((43.08, 93.84), abs=0.01)
    effector_m = end_effector_m(np.deg2rad(best_pose_degrees()))
    assert effector_m == pytest.approx([0.683, 0.0], abs=1e-9)


def test_only_two_joints_have_a_plane_of_poses() -> None:
    for preset in (load_preset("reaching-ch4"), load_preset("shirt-ch4")):
        with pytest.raises(PresetError, match="expected reaching with two joints"):
            pose_grid(preset)


def test_maps_are_what_the_discriminators_say(made: tuple[Path, list[FinishedRun]]) -> None:
    weights = kept_discriminators(made[0], PLAN, 2)
    maps = reward_maps(PLAN.preset, weights, GRID)
    logits = StoredDiscriminators(PLAN.preset, weights).logits(GRID.pictures)
    first, second = 2, 3  # 60 and 90 degrees
    for name in ("expert", "target"):
        probability = torch.sigmoid(logits[name].double())[first * 6 + second].item()
        assert maps[name][first, second] == pytest.approx(-np.log(1 - probability), rel=1e-4)
    assert np.allclose(maps["all"], maps["expert"] + maps["target"])
    alone = MAPPED.plan(MAPPED.panels[0], PGAIL, 0)
    assert list(reward_maps(alone.preset, kept_discriminators(made[0], alone, 1), GRID)) == ["all"]


def test_a_map_that_is_the_tasks_reward_has_a_full_score() -> None:
    score = score_map(PLAN, 1, GRID, "all", GRID.true_rewards)
    assert score.rank_correlation == pytest.approx(1.0)
    assert score.reachable_rank_correlation == pytest.approx(1.0)
    assert score.peak_degrees == (30.0, 120.0)
    assert score.peak_error_degrees == pytest.approx(np.hypot(13.08, 26.16), abs=0.01)
    against = score_map(PLAN, 1, GRID, "all", -GRID.true_rewards)
    assert against.rank_correlation == pytest.approx(-1.0)
    assert against.peak_reward == GRID.true_rewards.min()


def test_each_iterations_discriminators_are_kept(made: tuple[Path, list[FinishedRun]]) -> None:
    work, _ = made
    first, last = (kept_discriminators(work, PLAN, iteration) for iteration in (1, 2))
    assert first != last
    with InProcessRun(PLAN, work) as resumed:  # it is finished: as its last checkpoint has it
        assert resumed._discriminators is not None
        assert resumed._discriminators.weights_bytes() == last
    with pytest.raises(StorageError, match=r"in iteration 3; got .*weights stay where they were"):
        kept_discriminators(work, PLAN, 3)


def test_a_timeline_has_the_rewards_that_the_generator_gets(
    made: tuple[Path, list[FinishedRun]],
) -> None:
    weights = kept_discriminators(made[0], PLAN, 2)
    played = play_greedily(PLAN.preset, kept_policy(made[0], PLAN))
    timeline = score_steps("title", PLAN.preset, weights, played)
    uncentred = replace(
        PLAN.preset.imitation,
        discriminator=replace(PLAN.preset.imitation.discriminator, centre_rewards=False),
    )
    snapshot = StoredDiscriminators(replace(PLAN.preset, imitation=uncentred), weights)
    joined = snapshot.rewards(torch.tensor(played.observations[1:]))
    assert played.steps == PLAN.preset.task.horizon
    np.testing.assert_allclose(sum(timeline.rewards.values()), joined.numpy(), rtol=1e-5)


def test_the_page_has_maps_scores_and_a_timeline(
    made: tuple[Path, list[FinishedRun]], tmp_path: Path
) -> None:
    work, runs = made
    draw(MAPPED, runs, tmp_path, "the command", work)
    rows = [json.loads(line) for line in (tmp_path / NUMBERS).read_text().splitlines()]
    parts = [(row["condition"], row["iteration"], row["part"]) for row in rows]
    both = [("pgail-bid", it, part) for it in (1, 2) for part in ("all", "expert", "target")]
    assert parts == [*both, ("pgail", 1, "all"), ("pgail", 2, "all")]
    page = (tmp_path / PAGE).read_text()
    for name in (MAPS, MAP_SCORES, TIMELINE):
        assert f"({name})" in page
        assert (tmp_path / name).stat().st_size > 5000
    of_all = np.mean([row["rank_correlation"] for row in rows[:6:3]])
    assert f"| PGAIL-BiD | 1 | {of_all:+.2f} | needs two seeds |" in page
    peak = rows[2]["peak_degrees"]
    assert f"| PGAIL-BiD: D_T alone | 0 | {peak[0]:.0f}, {peak[1]:.0f} |" in page
    assert map_rewards(MAPPED, [], work, tmp_path) == []
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(work / "discriminators", elsewhere / "discriminators")
    assert len(map_rewards(MAPPED, runs, elsewhere, elsewhere)) == 2  # no policy, and no timeline


def test_a_page_is_drawn_from_numbers_where_weights_were_left_elsewhere(
    made: tuple[Path, list[FinishedRun]], tmp_path: Path
) -> None:
    work, runs = made
    docs, nowhere = tmp_path / "docs", tmp_path / "nowhere"
    draw(MAPPED, runs, docs, "the command", work)
    left = {path.name: path.read_bytes() for path in docs.iterdir()}
    draw(MAPPED, runs, docs, "the command", nowhere)
    assert {path.name: path.read_bytes() for path in docs.iterdir()} == left
    numbers = docs / NUMBERS
    numbers.write_text("".join(numbers.read_text().splitlines(keepends=True)[:-1]))
    with pytest.raises(StorageError, match=r"expected the discriminators of pgail-0-.*iteration 1"):
        draw(MAPPED, runs, docs, "the command", nowhere)
