"""Commands that learn from recordings, without a robot or a simulator."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from broker_config.errors import PresetError
from deploy.commands.option_rules import Settings
from deploy.process import FAILED_CHECK_EXIT, unfinished_exit
from learner.recorded import Demonstrations
from learner.steps.compute import Compute, TrainingPath


def train(
    sources: Annotated[tuple[Path, ...], tyro.conf.arg(name="from")],
    preset: str | None = None,
    settings: Settings = (),
    reward: str | None = None,
    demonstrations: Path | None = None,
    output: Path | None = None,
    runs: Path = Path("runs"),
    device: str = "cpu",
    training_path: TrainingPath | None = None,
) -> None:
    """Learn from what was recorded, without acting: the same run again, or another on its data.

    With nothing changed the weights are the recorded ones, bit for bit, on the same type of
    processor; else the exit code is 1.

    Args:
        sources: Run folders or recordings' folders; their episodes one source after the other.
        preset: Another algorithm and schedule for the same task: a preset's name or TOML file.
        settings: Settings that replace the preset's: algorithm.method=dqn.
        reward: Other rewards for the same transitions, also in place of discriminators: `task` for
            those that were recorded, or MODULE:FUNCTION, which gets a trajectory and returns one
            number for each step.
        demonstrations: In place of those that were recorded.
        output: The new run's folder, or one that was begun like this, to go on with; made under
            RUNS if not given.
        runs: Where run folders are made.
        device: Where to compute: cpu, cuda.
        training_path: How gradient steps are made; chosen by the device if not given.
    """
    from deploy.offline.origin import keep_origin, origin_of
    from deploy.offline.recorded_episodes import read_episodes, source_paths
    from deploy.offline.train_from import (
        compare_weights,
        load_reward,
        offline_preset,
        recorded_demonstrations,
        train_from,
    )
    from deploy.presets import load_preset
    from deploy.run_folder import create_run_folder, prepare_run_folder
    from deploy.running.kept_compute import settle_compute
    from learner.recorded import read_demonstrations

    console = Console()
    episodes = read_episodes(source_paths(sources))
    for run in episodes.runs:
        left_out = f"; {run.left_out} behind a gap left out" if run.left_out else ""
        text = f"{run.path}: {run.episodes} episodes of {run.preset.name}{left_out}"
        console.print(text, highlight=False, soft_wrap=True)
    function = load_reward(reward) if reward else None
    base = load_preset(preset) if preset else None
    chosen = offline_preset(episodes, base, settings, imitates=function is None)
    given: Demonstrations | None = None
    if demonstrations is not None:
        given = read_demonstrations(demonstrations)  # where they are of no use, it is said
    elif chosen.initialisation or chosen.imitation:
        given = recorded_demonstrations(episodes.runs)
    folder = (
        create_run_folder(runs, chosen) if output is None else prepare_run_folder(output, chosen)
    )
    keep_origin(folder, origin_of(episodes, given, reward))
    compute = settle_compute(folder, Compute(device, training_path))
    if not train_from(folder, chosen, episodes, given, function, compute, console):
        sys.exit(unfinished_exit())
    recorded = episodes.runs[0]
    # A run that was stopped is learned from as far as it came.
    iterations = recorded.preset.schedule.iterations
    whole = replace(chosen, schedule=replace(chosen.schedule, iterations=iterations))
    is_the_same = whole == recorded.preset and function is None and demonstrations is None
    if is_the_same and len(episodes.runs) == 1:
        comparison = compare_weights(folder, recorded)
        console.print(f"Compared with {recorded.path}: {comparison}", soft_wrap=True)
        if comparison.others:
            sys.exit(FAILED_CHECK_EXIT)


def replay(
    sources: Annotated[tuple[Path, ...], tyro.conf.Positional],
    /,
    as_: Annotated[Literal["actors"] | None, tyro.conf.arg(name="as")] = None,
    view: bool = False,
    connect: str = "tcp/127.0.0.1:7447",
    run: str | None = None,
    id: str = "replay",  # noqa: A002 - the option's name
    speed: float = 1.0,
    step: bool = False,
    zenoh: tuple[str, ...] = (),
) -> None:
    """Bring a recording back onto the bus.

    With `--as actors` it answers the tickets of a learner that runs now with the recorded episodes,
    and says how many of them another policy has played than the learner's. With `--view` it
    publishes the recorded views, metrics, policies, discriminators and presence again, for consoles
    and viewers.

    Args:
        sources: Run folders or recordings; with `--view`, one.
        as_: As what the episodes come back.
        view: Show it again.
        connect: Address of the router, or a run folder that `clothbus run` made.
        run: As actors: the run to act for; not needed when the router carries one run. With
            `--view`: the name to appear under; RUN-replay if not given.
        id: As actors: under which name.
        speed: With `--view`: how much faster than it was; inf for no waiting.
        step: With `--view`: publish one message for each Enter.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.offline.recorded_episodes import source_paths
    from deploy.offline.replay import replay_as_actors, replay_as_views
    from deploy.run_folder import router_address

    if (as_ is None) == (not view):
        raise PresetError("replay: expected --as actors or --view; give exactly one of them")
    if (as_ is not None and (step or speed != 1.0)) or (step and speed != 1.0):
        raise PresetError(
            "replay: expected --speed or --step, and with --view only; got more; leave one of them "
            "out"
        )
    address = router_address(connect)
    if as_ is not None:
        if not replay_as_actors(source_paths(sources), address, run, id, zenoh, Console()):
            sys.exit(unfinished_exit())
        return
    if len(sources) != 1:
        raise PresetError(f"replay: expected one recording to view; got {len(sources)}")
    if math.isnan(speed) or speed <= 0:
        raise PresetError(f"--speed: expected a number above 0; got {speed:g}")
    if not replay_as_views(sources[0], address, run, speed, step, zenoh, Console()):
        sys.exit(unfinished_exit())
