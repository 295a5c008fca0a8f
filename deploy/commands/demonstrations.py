"""The commands of `clothbus demos`: `make`, `import`, `show`, `label`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from broker_config.errors import PresetError
from broker_config.messages import Trajectory
from broker_config.preset import Preset
from deploy.commands.option_rules import Settings, refuse_unknown_task

if TYPE_CHECKING:
    from deploy.demonstrations.demonstrators import ActingDemonstrator

app = tyro.extras.SubcommandApp()

Kind = Literal["scripted", "random", "policy"]

_MARK = re.compile(r"(\d+):(\d+(?:-\d+)?(?:,\d+(?:-\d+)?)*)")


@app.command(name="make")
def make(
    preset: Annotated[str, tyro.conf.Positional],
    /,
    output: Path,
    episodes: int = 10,
    demonstrator: Kind = "scripted",
    mistakes: float = 0.0,
    quality: float | None = None,
    quality_episodes: int = 20,
    jobs: int = 1,
    run: Path | None = None,
    version: int | None = None,
    least_targets: int | None = None,
    settings: Settings = (),
) -> None:
    """Make demonstrations of a preset's task, as MCAP.

    Args:
        preset: A preset's name or TOML file.
        output: Folder to record into; an unfinished one is gone on with.
        episodes: How many there shall be.
        demonstrator: Who acts: the task's script, chance, or a policy under training.
        mistakes: Share of the script's actions that are replaced by random ones.
        quality: In place of a share: 0 is as good as chance, 1 as the script. The share is found.
        quality_episodes: By which the quality of each share is measured.
        jobs: Processes that measure it.
        run: Folder of the run whose policy acts, as it does in the run.
        version: Of that policy; the newest if not given.
        least_targets: Draw all of them anew, whatever their returns, until so many target states
            are among them; 3 for a policy where the preset has a reward for targets, otherwise 0.
        settings: Settings that replace the preset's.
    """
    from deploy.demonstrations.demonstrators import by_script_of_quality
    from deploy.demonstrations.making import LEAST_TARGETS, make_demonstrations
    from deploy.demonstrations.sheet import Targets
    from deploy.presets import load_preset

    for option, value, least in (("episodes", episodes, 1), ("least-targets", least_targets, 0)):
        if value is not None and value < least:
            raise PresetError(f"--{option}: expected at least {least}; got {value}")
    _refuse_contradictions(demonstrator, mistakes, quality, run, version)
    console, chosen = Console(), load_preset(preset, settings)
    refuse_unknown_task(chosen)
    if quality is not None:
        acting = by_script_of_quality(chosen, output, quality, quality_episodes, jobs)
    else:
        acting = _acting(chosen, demonstrator, mistakes, run, version)
    if least_targets is None:
        has_rule = chosen.imitation is not None and chosen.imitation.target_reward is not None
        least_targets = LEAST_TARGETS if demonstrator == "policy" and has_rule else 0

    def say(line: str) -> None:
        console.print(line, highlight=False, soft_wrap=True)

    say(f"By {acting.who}")
    made = make_demonstrations(
        chosen, output, episodes, acting, least_targets, lambda *played: say(_line_of(*played))
    )
    targets = Targets(made)
    say(
        f"{output}: {len(made.trajectories)} episodes, {made.samples} samples, {targets.count} "
        f"target states ({targets.rule})"
    )


def _line_of(trajectory: Trajectory, draw: int) -> str:
    again = f", draw {draw}" if draw else ""
    success = "success" if trajectory.success else "no success"
    return (
        f"episode {trajectory.ticket.index}: {trajectory.steps} steps, return "
        f"{trajectory.return_:.2f}, {success}{again}"
    )


def _refuse_contradictions(
    demonstrator: Kind,
    mistakes: float,
    quality: float | None,
    run: Path | None,
    version: int | None,
) -> None:
    if (mistakes or quality is not None) and demonstrator != "scripted":
        raise PresetError(
            "demos make: expected --mistakes and --quality with the scripted demonstrator alone; "
            f"got one with --demonstrator {demonstrator}; leave it out"
        )
    if mistakes and quality is not None:
        raise PresetError(
            "demos make: expected --mistakes or --quality; got both; give one of them"
        )
    if (run is not None) != (demonstrator == "policy") or (version is not None and run is None):
        raise PresetError(
            "demos make: expected --run, and --version if wanted, exactly with --demonstrator "
            f"policy; got run {run}, version {version} and {demonstrator}; name a run folder"
        )


def _acting(
    preset: Preset, kind: Kind, mistakes: float, run: Path | None, version: int | None
) -> ActingDemonstrator:
    from deploy.demonstrations.demonstrators import by_chance, by_policy, by_script
    from deploy.process import use_one_torch_thread
    from deploy.run_folder import RunFolder

    if run is not None:
        use_one_torch_thread()
        return by_policy(preset, RunFolder(run), version)
    return by_chance(preset) if kind == "random" else by_script(preset, mistakes)


@app.command(name="import")
def import_(
    dataset: Annotated[str, tyro.conf.Positional],
    /,
    preset: str,
    output: Path,
    settings: Settings = (),
) -> None:
    """Import a Minari dataset as demonstrations of a preset's task, as MCAP.

    Args:
        dataset: A dataset's folder, or its name in Minari's local storage.
        preset: A preset's name or TOML file, with the dataset's observations and actions.
        output: The folder to make.
        settings: Settings that replace the preset's.
    """
    from broker_config.durable import require_new
    from deploy.count_progress import count_progress
    from deploy.exchange.minari_import import MinariDataset, import_minari
    from deploy.presets import load_preset

    require_new(output)
    chosen = load_preset(preset, settings)
    read = MinariDataset(dataset, chosen.task)
    with count_progress("Importing", read.episodes) as on_trajectory:
        steps = import_minari(read, chosen, output, on_trajectory)
    Console().print(
        f"{output}: {read.episodes} episodes, {steps} samples of {read.who.id}",
        highlight=False,
        soft_wrap=True,
    )


@app.command(name="show")
def show(folder: Annotated[Path, tyro.conf.Positional], /, output: Path | None = None) -> None:
    """Show what demonstrations hold: a table, and a picture of every state.

    Args:
        folder: Of `clothbus demos make`; or a run folder, or a run's recording.
        output: A .png for a contact sheet, with targets framed; it is replaced.
    """
    from broker_config.messages import DemonstrationsBegun
    from deploy.demonstrations.sheet import Targets, demonstration_table, draw_contact_sheet
    from learner.recorded import read_demonstrations

    console, demonstrations = Console(), read_demonstrations(folder)
    origin, targets = demonstrations.origin, Targets(demonstrations)
    if isinstance(origin, DemonstrationsBegun):
        draw = f" (draw {origin.draw})" if origin.draw else ""
        console.print(f"By {origin.demonstrator}{draw}", highlight=False, soft_wrap=True)
    console.print(demonstration_table(demonstrations, targets))
    if output is not None:
        draw_contact_sheet(output, demonstrations, targets)
        console.print(f"{output}", highlight=False, soft_wrap=True)


@app.command(name="label")
def label(
    folder: Annotated[Path, tyro.conf.Positional],
    /,
    targets: tuple[str, ...] = (),
    clear: bool = False,
) -> None:
    """Mark states of demonstrations as targets; then only what is marked is one.

    Args:
        folder: Of `clothbus demos make`.
        targets: EPISODE:STATES each, such as 0:28-30 or 1:3,30, as `clothbus demos show` numbers
            them; they replace what was marked in that episode.
        clear: Take back all other marks.
    """
    from deploy.demonstrations.folder import label_targets

    if not targets and not clear:
        raise PresetError(
            "demos label: expected --targets or --clear; got neither; mark states, such as 0:28-30"
        )
    marks = label_targets(folder, _parsed(targets), clear=clear)
    count = sum(len(mark.states) for mark in marks)
    Console().print(
        f"{folder}: {count} target states marked in {len(marks)} episodes",
        highlight=False,
        soft_wrap=True,
    )


def _parsed(targets: Sequence[str]) -> dict[int, set[int]]:
    """The states of each episode that are to be marked."""
    states: dict[int, set[int]] = {}
    for text in targets:
        if (found := _MARK.fullmatch(text)) is None:
            raise PresetError(
                f"--targets {text}: expected EPISODE:STATES; got something else; write for example "
                "0:28-30 or 1:3,30"
            )
        marked = states.setdefault(int(found[1]), set())
        for part in found[2].split(","):
            first, _, last = part.partition("-")
            added = range(int(first), int(last or first) + 1)
            if not added or added[0] == 0:
                raise PresetError(
                    f"--targets {text}: expected states from 1 on, the lower first; got {part}; "
                    "state 0 comes before any action"
                )
            marked.update(added)
    return states
