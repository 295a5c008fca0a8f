"""`clothbus watch`: an episode as a moving picture, with what each action did drawn into it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from actors.acting import Greedy, UniformlyRandom
from actors.demonstrate.acting import scripted_demonstrator
from actors.envs import ClothbusEnv, ClothTaskEnv, make_env
from actors.policy import Policy
from actors.rollout import ActingPolicy
from broker_config.errors import PresetError, StorageError
from deploy.evaluation.policies import newest_policy
from deploy.run_folder import RunFolder

FRAME_SECS: Final = 0.6
ROBOT_FRAME_SECS: Final = 0.2
SIZE_PX: Final = 336
SUFFIXES: Final = (".gif", ".mp4")

Picture = NDArray[np.uint8]
_PICK, _DROP, _LINE = (255, 255, 255), (20, 20, 20), (40, 60, 220)


@dataclass(frozen=True)
class WatchedEpisode:
    """An episode's pictures and outcome."""

    frames: list[Picture]
    """u8[size, size, 3]: at first the cloth; for each action what is to be done, the robot doing
    it, where there is one, and what came of it."""

    n_actions: int
    frame_secs: float
    """How long each is shown: a robot is shown as fast as it moves."""

    return_: float
    success: bool


def watch(
    env_id: str, who: str, options: Mapping[str, Any], seed: int, output: Path
) -> WatchedEpisode:
    """Plays an episode and writes it.

    Args:
        env_id: of `actors.envs.ENV_IDS`.
        who: "scripted", "random", or a run folder, whose newest policy plays greedily.
        options: keywords of the environment.
        seed: of the environment, and of chance.
        output: a file that ends in .gif or .mp4; it is replaced.

    Raises:
        PresetError: another ending, or a policy that does not fit the task.
        StorageError: the folder holds no policy, or the file cannot be written.
        ValueError: the task or an option does not exist.
    """
    if output.suffix not in SUFFIXES:
        raise PresetError(
            f"output: expected a file that ends in {' or '.join(SUFFIXES)}; got {output}; "
            "choose one of them"
        )
    env = make_env(env_id, **{"render_mode": "rgb_array", "render_px": SIZE_PX, **options})
    try:
        episode = played(env, _policy(who, env), seed)
    finally:
        env.close()
    _write(episode, output)
    return episode


def _policy(who: str, env: ClothbusEnv) -> ActingPolicy:
    n_actions = int(env.action_space.n)  # type: ignore[attr-defined]  # all tasks are discrete
    if who == "random":
        return UniformlyRandom(n_actions)
    if who == "scripted":
        return scripted_demonstrator(env, n_actions, mistake_rate=0.0)
    return Greedy(_learned(RunFolder(Path(who)), env, n_actions))


def _learned(folder: RunFolder, env: ClothbusEnv, n_actions: int) -> Policy:
    preset = folder.read_preset()
    expected = (tuple(preset.task.observation_shape), preset.task.n_actions)
    got = (tuple(env.observation_space.shape or ()), n_actions)
    if expected != got:
        raise PresetError(
            f"{folder.path}: expected a task with observations {list(expected[0])} and "
            f"{expected[1]} actions, as its policy has; got {list(got[0])} and {got[1]}; watch it "
            f"at {preset.task.environment}"
        )
    return newest_policy(folder, preset)


def played(env: ClothbusEnv, policy: ActingPolicy, seed: int) -> WatchedEpisode:
    """An episode as it is seen, by an environment with a render mode."""
    frame_secs = _frame_secs(env)
    stands = round(FRAME_SECS / frame_secs)
    random = np.random.default_rng([seed, 2])
    picture, _ = env.reset(seed=seed)
    cloth = _rendered(env)
    frames, return_, n_actions, is_over = [cloth] * stands, 0.0, 0, False
    while not is_over:
        picture, reward, terminated, truncated, info = env.step(policy.act(picture, random, 0.0))
        return_ += float(reward)
        n_actions += 1
        is_over = terminated or truncated
        frames += [_annotated(env, cloth, info)] * stands
        frames += _robot_film(env)
        cloth = cloth if info["guard"] else _rendered(env)
        frames += [cloth] * stands
    return WatchedEpisode(frames, n_actions, frame_secs, return_, bool(info["success"]))


def _frame_secs(env: ClothbusEnv) -> float:
    """How long to show each picture; a robot is filmed from now on."""
    task = env.unwrapped
    if not isinstance(task, ClothTaskEnv) or task.arms is None:
        return FRAME_SECS
    task.arms.film_every_secs = ROBOT_FRAME_SECS
    return ROBOT_FRAME_SECS


def _robot_film(env: ClothbusEnv) -> list[Picture]:
    task = env.unwrapped
    return task.robot_film() if isinstance(task, ClothTaskEnv) else []


def _rendered(env: ClothbusEnv) -> Picture:
    frame = env.render()
    assert isinstance(frame, np.ndarray), "it was made with a render mode"
    return np.asarray(frame, dtype=np.uint8)


def _annotated(env: ClothbusEnv, frame: Picture, info: Mapping[str, Any]) -> Picture:
    """The picture before an action with the action drawn into it; reaching has nothing to draw."""
    drawn = frame.copy()
    task = env.unwrapped
    if not isinstance(task, ClothTaskEnv):
        return drawn
    scale = len(frame) / task.options.observation_px

    def pixel(xy_m: tuple[float, float]) -> tuple[int, int]:
        x, y = task.camera.project_px(np.array([*xy_m, 0.0])) * scale
        return round(float(x)), round(float(y))

    if "fold_line_m" in info:
        start, end = map(pixel, info["fold_line_m"])
        cv2.line(drawn, start, end, _LINE, 2, cv2.LINE_AA)
    if "pick_px" in info:
        column, row = ((coordinate + 0.5) * scale for coordinate in info["pick_px"])
        moves = [((round(column), round(row)), pixel(info["drop_xy_m"]))]
    else:
        moves = list(zip(map(pixel, info["grasps_m"]), map(pixel, info["drops_m"]), strict=True))
    for pick, drop in moves:
        cv2.arrowedLine(drawn, pick, drop, _PICK, 2, cv2.LINE_AA, tipLength=0.12)
        cv2.circle(drawn, pick, 5, _PICK, -1, cv2.LINE_AA)
        cv2.circle(drawn, drop, 3, _DROP, -1, cv2.LINE_AA)
    return drawn


def _write(episode: WatchedEpisode, output: Path) -> None:
    frames, frame_secs = episode.frames, episode.frame_secs
    output.parent.mkdir(parents=True, exist_ok=True)
    if output.suffix == ".gif":
        first, *rest = [Image.fromarray(frame) for frame in frames]
        duration_ms = round(1e3 * frame_secs)
        first.save(output, save_all=True, append_images=rest, duration=duration_ms, loop=0)
        return
    height, width = frames[0].shape[:2]
    codec = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(output), codec, 1 / frame_secs, (width, height))
    if not writer.isOpened():
        raise StorageError(
            f"{output}: expected a file that can be written; got none; check the folder, or write "
            "a .gif"
        )
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()
