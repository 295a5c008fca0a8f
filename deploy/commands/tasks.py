"""The commands that look at a task alone: `task`, `reach`, `watch`, `spread`, `states`."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from broker_config.errors import PresetError, StorageError
from broker_config.preset import toml_value
from deploy.commands.option_rules import require_positive
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
    from deploy.tasks.task_check import check_task

    require_positive("episodes", episodes)
    require_positive("jobs", jobs)
    try:
        check = check_task(_whole_id(env_id), _parsed(options), episodes, jobs)
    except ValueError as error:
        raise PresetError(str(error)) from error
    Console().print(check.table())
    if not check.holds:
        sys.exit(FAILED_CHECK_EXIT)


def reach(
    env_id: Annotated[str, tyro.conf.Positional],
    /,
    episodes: int = 10,
    options: Options = (),
) -> None:
    """Say what portion of a task's actions the robot can make, and what is in the way of others.

    Args:
        env_id: A cloth task's id, such as ShirtFold or clothbus/ShirtFold-v0.
        episodes: Of the scripted expert.
        options: Arguments of the environment, such as robot_stance="left".
    """
    from deploy.tasks.reach_check import check_reach

    if episodes < 1:
        raise PresetError(f"--episodes: expected at least 1; got {episodes}")
    try:
        check = check_reach(_whole_id(env_id), _parsed(options), episodes)
    except ValueError as error:
        raise PresetError(str(error)) from error
    Console().print(check.table())


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
        options: Arguments of the environment, such as engine="pybullet" difficulty="hard" or
            robot=true, which shows the arms.
    """
    from deploy.tasks.watch import watch as write_episode

    try:
        episode = write_episode(_whole_id(env_id), who, _parsed(options), seed, output)
    except ValueError as error:
        raise PresetError(str(error)) from error
    Console().print(
        f"{output}: {episode.n_actions} actions, return {episode.return_:.2f}, "
        f"{'success' if episode.success else 'no success'} at the end",
        highlight=False,
    )


def spread(
    env_id: Annotated[str, tyro.conf.Positional] = "HandkerchiefFlip36",
    /,
    episodes: int = 100,
    jobs: int = 1,
    size_px: int = 84,
    states: tuple[str, ...] = ("crumpled", "random", "creased", "folded_over"),
    up: Literal["green", "red", "either"] = "either",
    first_seed: int = 1000,
    film_strip: Path | None = None,
    options: Options = (),
) -> None:
    """Test the automatic reset: nine in ten handkerchiefs must lie spread again.

    Args:
        env_id: A task with a handkerchief.
        episodes: Of each state.
        jobs: Processes.
        size_px: Width of the pictures that the rule sees.
        states: In which the handkerchief lies at first.
        up: The side that must be up in the end.
        first_seed: Of the episodes; the rule's numbers were chosen on seeds below 300.
        film_strip: A .png for the first episode of the first state; it is replaced.
        options: Arguments of the environment, such as engine="pybullet".
    """
    from deploy.tasks.spread_check import Trial, check_spreading, draw_film_strip

    numbers = (
        ("episodes", episodes, 1),
        ("jobs", jobs, 1),
        ("size-px", size_px, 32),
        ("first-seed", first_seed, 0),
    )
    for option, value, least in numbers:
        if value < least:
            raise PresetError(f"--{option}: expected at least {least}; got {value}")
    if not states:
        raise PresetError("--states: expected at least one; got none; leave it out for all")
    side = None if up == "either" else up
    trial = Trial(_whole_id(env_id), _parsed(options), size_px, side)
    try:
        if film_strip is not None:
            draw_film_strip(film_strip, trial, states[0])
        check = check_spreading(trial, states, episodes, jobs, first_seed)
    except ValueError as error:
        raise PresetError(str(error)) from error
    Console().print(check.table())
    if not check.holds:
        sys.exit(FAILED_CHECK_EXIT)


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
    from deploy.tasks.make_states import make_states

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
