"""The commands that need a task alone, no bus or learner: `clothbus task`, `watch`, `states`."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from broker_config.errors import PresetError, StorageError
from broker_config.preset import toml_value
from deploy.process import FAILED_CHECK_EXIT

Options = Annotated[tuple[str, ...], tyro.conf.arg(name="set")]
_PREFIX = "clothbus/"


def task(
    env_id: Annotated[str, tyro.conf.Positional],
    /,
    episodes: int = 40,
    jobs: int = 1,
    options: Options = (),
) -> None:
    """Test a task: its scripted expert must succeed at the end, random play must not flip a cloth.

    Args:
        env_id: A task's id, such as ShirtFold or clothbus/ShirtFold-v0.
        episodes: Of the expert, and of random play.
        jobs: Processes.
        options: Arguments of the environment, such as engine="pybullet" difficulty="hard".
    """
    from deploy.task_check import check_task

    for option, value in (("episodes", episodes), ("jobs", jobs)):
        if value < 1:
            raise PresetError(f"--{option}: expected at least 1; got {value}")
    try:
        check = check_task(_whole_id(env_id), _parsed(options), episodes, jobs)
    except ValueError as error:
        raise PresetError(str(error)) from error
    Console().print(check.table())
    if not check.holds:
        sys.exit(FAILED_CHECK_EXIT)


def watch(
    env_id: Annotated[str, tyro.conf.Positional],
    /,
    output: Path,
    who: str = "scripted",
    seed: int = 0,
    options: Options = (),
) -> None:
    """Write an episode of a task as a moving picture.

    Args:
        env_id: A task's id, such as ShirtFold or clothbus/ShirtFold-v0.
        output: A file that ends in .gif or .mp4.
        who: scripted, random, or a run folder, whose newest policy plays greedily.
        seed: Of the episode.
        options: Arguments of the environment, such as engine="pybullet" difficulty="hard".
    """
    from deploy.watch import watch as write_episode

    try:
        episode = write_episode(_whole_id(env_id), who, _parsed(options), seed, output)
    except ValueError as error:
        raise PresetError(str(error)) from error
    Console().print(
        f"{output}: {len(episode.frames) // 2} actions, return {episode.return_:.2f}, "
        f"{'success' if episode.success else 'no success'} at the end",
        highlight=False,
    )


def states(
    env_id: Annotated[str, tyro.conf.Positional],
    /,
    output: Path,
    names: tuple[str, ...],
    seeds: int = 10,
    options: Options = (),
) -> None:
    """Store initial states of a task, so that every later evaluation begins with the same cloth.

    Args:
        env_id: A cloth task's id, such as ShirtFold or clothbus/ShirtFold-v0.
        output: A file that ends in .npz; it is replaced.
        names: Of the initial states.
        seeds: How many of each name, from seeds that count from 0.
        options: Arguments of the environment, such as difficulty="hard" spacing_m=0.02.
    """
    from actors.envs.stored_states import write_stored_states
    from deploy.make_states import make_states

    if seeds < 1:
        raise PresetError(f"--seeds: expected at least 1; got {seeds}")
    try:
        made = make_states(_whole_id(env_id), _parsed(options), names, seeds)
        write_stored_states(output, made)
    except ValueError as error:
        raise PresetError(str(error)) from error
    except OSError as error:
        raise StorageError(f"{output}: {error}; choose a place that can be written") from error
    Console().print(
        f"{output}: {len(made.names)} states of {made.garment}, "
        f"{output.stat().st_size / 1e3:.0f} kB, digest {made.digest[:12]}",
        highlight=False,
    )


def _whole_id(env_id: str) -> str:
    return env_id if env_id.startswith(_PREFIX) else f"{_PREFIX}{env_id}-v0"


def _parsed(options: Iterable[str]) -> dict[str, Any]:
    """Keywords from `name=value`."""
    parsed: dict[str, Any] = {}
    for option in options:
        name, separator, value = option.partition("=")
        if not separator or not name.isidentifier():
            raise PresetError(
                f"--set {option}: expected name=value; got no such pair; write for example "
                'difficulty="hard"'
            )
        parsed[name] = toml_value(value)
    return parsed
