"""The command line: `clothbus COMMAND --help` explains each."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console
from rich.table import Table

from broker_config.errors import ClothbusError, PresetError, RouterUnreachable
from broker_config.heart import HUNG_SECS
from broker_config.messages import Command
from broker_config.preset import Preset
from broker_config.session import DEFAULT_ADDRESS
from deploy import policy_commands, task_commands
from deploy.priority import Priority
from deploy.process import (
    CONFIGURATION_EXIT,
    UNREACHABLE_EXIT,
    end_with_supervisor,
    log_to_stderr,
    unfinished_exit,
)
from deploy.reproduce.command import reproduce
from learner.compute import Compute, TrainingPath

SHORTEST_HUNG_SECS = 10.0

# What a command needs beyond this is imported when it runs: `clothbus status` shall not wait for
# torch and a physics engine.

app = tyro.extras.SubcommandApp()

Settings = Annotated[tuple[str, ...], tyro.conf.arg(name="set")]


@app.command(name="run")
def run(
    preset: Annotated[str | None, tyro.conf.Positional] = None,
    /,
    actors: int = 1,
    in_process: bool = False,
    resume: Path | None = None,
    runs: Path = Path("runs"),
    settings: Settings = (),
    device: str = "cpu",
    training_path: TrainingPath | None = None,
    demonstrations: Path | None = None,
    connect: str | None = None,
    step_log: Path | None = None,
    evaluate: int = 0,
    evaluator_priority: Priority = "idle",
    hung_secs: float = HUNG_SECS,
    record: bool = True,
    zenoh: tuple[str, ...] = (),
) -> None:
    """Train a preset: router, learner and actors on this machine, with live progress.

    Args:
        preset: A preset's name or TOML file; `clothbus presets` lists them.
        actors: Actor processes.
        in_process: The same cores in one process, without a bus.
        resume: Continue this run folder instead of starting a preset.
        runs: Where run folders are made.
        settings: Settings that replace the preset's: schedule.iterations=3.
        device: Where the learner computes: cpu, cuda.
        training_path: How gradient steps are made; chosen by the device if not given.
        demonstrations: Folder of `clothbus collect`, for presets with an initialisation.
        connect: Address of a router that runs already; without it one is started.
        step_log: File for one line per step on the environment's side.
        evaluate: Have an evaluator score each iteration's policy over so many episodes meanwhile;
            0 for none.
        evaluator_priority: `idle` has what processor time is left over; `normal`, a share.
        hung_secs: A process that gets nowhere for so long is killed and started again.
        record: Record the run as MCAP into its folder; a run in one process is not recorded.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.presets import load_preset
    from deploy.run import RunOptions, run_over_bus
    from deploy.run_folder import RunFolder, create_run_folder

    _require_positive("actors", actors)
    _require_patience(hung_secs)
    _require_evaluable(evaluate, in_process)
    if (preset is None) == (resume is None):
        raise PresetError("run: expected a PRESET or --resume FOLDER; give exactly one of them")
    if resume is not None:
        folder = RunFolder(resume)
        chosen = folder.read_preset()
    else:
        chosen = load_preset(str(preset), settings)
        _refuse_unsupported(chosen)
        folder = create_run_folder(runs, chosen)
    options = RunOptions(
        actors=actors,
        compute=Compute(device, training_path),
        address=connect,
        demonstrations=demonstrations,
        step_log=step_log,
        evaluate=evaluate,
        evaluator_priority=evaluator_priority,
        hung_secs=hung_secs,
        overrides=zenoh,
        record=record,
    )
    carry_out = run_over_bus
    if in_process:
        from deploy.run_in_process import run_in_process

        carry_out = run_in_process
    if not carry_out(folder, chosen, options, Console()):
        sys.exit(unfinished_exit())


def _refuse_unsupported(preset: Preset) -> None:
    if preset.imitation is not None:
        raise PresetError(
            f"{preset.name}: expected a preset without [imitation]; got one; rewards from "
            "discriminators are not part of this version, choose a preset of chapter 3"
        )
    _refuse_unknown_task(preset)


def _refuse_unknown_task(preset: Preset) -> None:
    from actors.envs import ENV_IDS

    if preset.task.environment not in ENV_IDS:
        raise PresetError(
            f"{preset.name}: expected a task of {', '.join(ENV_IDS)}; got "
            f"{preset.task.environment}; this version does not have it"
        )


@app.command(name="presets")
def presets() -> None:
    """List the presets that come with clothbus."""
    from deploy.presets import load_preset, preset_names

    table = Table("preset", "task", "source")
    for name in preset_names():
        preset = load_preset(name)
        table.add_row(name, preset.task.environment, preset.source)
    Console().print(table)


@app.command(name="router")
def router(
    listen: str | None = None, address_file: Path | None = None, zenoh: tuple[str, ...] = ()
) -> None:
    """Route the bus.

    Args:
        listen: Address to listen at; tcp/127.0.0.1:7447 unless an address file is given.
        address_file: Choose a free port, and write the address into this file.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.roles import run_router

    if listen is None and address_file is None:
        listen = DEFAULT_ADDRESS
    run_router(listen, address_file, zenoh)


@app.command(name="learner")
def learner(
    folder: Annotated[Path, tyro.conf.Positional],
    /,
    preset: str | None = None,
    settings: Settings = (),
    connect: str = DEFAULT_ADDRESS,
    device: str = "cpu",
    training_path: TrainingPath | None = None,
    demonstrations: Path | None = None,
    hung_secs: float = HUNG_SECS,
    zenoh: tuple[str, ...] = (),
) -> None:
    """Learn, and own the run's journal; an existing run folder is resumed.

    Args:
        folder: The run folder.
        preset: For a new folder: a preset's name or TOML file.
        settings: Settings that replace the preset's.
        connect: Address of the router.
        device: Where to compute: cpu, cuda.
        training_path: How gradient steps are made; chosen by the device if not given.
        demonstrations: Folder of `clothbus collect`.
        hung_secs: An actor that gets nowhere for so long loses its ticket to another one.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.presets import load_preset
    from deploy.roles import run_learner
    from deploy.run_folder import RunFolder, prepare_run_folder

    _require_patience(hung_secs)
    if preset is None:
        run_folder = RunFolder(folder)
    else:
        chosen = load_preset(preset, settings)
        _refuse_unsupported(chosen)
        run_folder = prepare_run_folder(folder, chosen)
    chosen, compute = run_folder.read_preset(), Compute(device, training_path)
    run_learner(run_folder, chosen, connect, compute, demonstrations, hung_secs, zenoh)


@app.command(name="actor")
def actor(
    id: str = "actor-0",  # noqa: A002 - the option's name
    connect: str = DEFAULT_ADDRESS,
    run: str | None = None,
    spool: Path | None = None,
    preset: str | None = None,
    settings: Settings = (),
    spool_steps: bool = False,
    step_log: Path | None = None,
    zenoh: tuple[str, ...] = (),
) -> None:
    """Act for a run, on this or another machine.

    Args:
        id: This actor's name; every actor has its own.
        connect: Address of the router.
        run: The run's name; not needed when the router carries one run.
        spool: File in which trajectories wait for their ack; spools/RUN/ID.sqlite if not given.
        preset: What the run must be; without it, the actor takes what the run is.
        settings: Settings that replace the preset's.
        spool_steps: Make each step durable before the next, as a robot must.
        step_log: File for one line per step on the environment's side.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.presets import load_preset
    from deploy.roles import run_actor

    run_actor(
        connect,
        id,
        spool,
        run,
        load_preset(preset, settings) if preset else None,
        spool_steps,
        step_log,
        zenoh,
    )


@app.command(name="record")
def record(
    output: Path,
    id: str = "recorder",  # noqa: A002 - the option's name
    connect: str = DEFAULT_ADDRESS,
    run: str | None = None,
    zenoh: tuple[str, ...] = (),
) -> None:
    """Record a run as MCAP: its whole journal and policies, and what is seen of its live traffic.

    Args:
        output: Folder of the recording; one that is there already is gone on with.
        id: This recorder's name; every recorder of a run has its own.
        connect: Address of the router, or a run folder that `clothbus run` made.
        run: The run's name; not needed when the router carries one run.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.roles import run_recorder

    run_recorder(_address(connect), id, output, run, zenoh)


@app.command(name="status")
def status(
    connect: str = DEFAULT_ADDRESS, run: str | None = None, zenoh: tuple[str, ...] = ()
) -> None:
    """Show who is alive, the iteration, policy versions, lag and spools.

    Args:
        connect: Address of the router, or a run folder that `clothbus run` made.
        run: The run's name; not needed when the router carries one run.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.status import read_status, status_table

    address = _address(connect)
    name = run or _only_run(address, zenoh)
    Console().print(status_table(name, read_status(address, name, zenoh)))


@app.command(name="control")
def control(
    command: Annotated[Literal["pause", "resume", "drain", "stop", "forget"], tyro.conf.Positional],
    /,
    connect: str = DEFAULT_ADDRESS,
    run: str | None = None,
    process: str | None = None,
    zenoh: tuple[str, ...] = (),
) -> None:
    """Pause, resume, drain or stop a run, or forget a recorder.

    Args:
        command: What to do; `drain` has actors deliver and leave, `forget` keeps no policy versions
            any more for a recorder that will not come back.
        connect: Address of the router, or a run folder that `clothbus run` made.
        run: The run's name; not needed when the router carries one run.
        process: The actor to drain, the recorder to forget; all of them if not given.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.status import send_control

    address = _address(connect)
    name = run or _only_run(address, zenoh)
    reply = send_control(address, name, Command(command), process, zenoh)
    Console().print(f"{name}: {reply.state}", highlight=False)


@app.command(name="evaluate")
def evaluate(
    folder: Annotated[Path, tyro.conf.Positional],
    /,
    episodes: int | None = None,
    versions: tuple[int, ...] = (),
    mode: Literal["sampled", "greedy"] | None = None,
    jobs: int = 1,
    stored_states: str | None = None,
    initial_states: tuple[str, ...] = (),
) -> None:
    """Score policy versions of a run on seeds of their own, or on stored initial states.

    Args:
        folder: The run folder.
        episodes: Episodes for each version, 100 if not given; of stored states, for each initial
            state, all of them if not given.
        versions: Policy versions; the untrained and the newest if none is given.
        mode: Sample actions from the policy, or take the preferred ones; DQN has the latter only.
        jobs: Processes.
        stored_states: A file of `clothbus states`, or handkerchief, shirt, trousers, which come
            with clothbus.
        initial_states: Which of them; all if none is given.
    """
    from deploy.evaluate import evaluate as evaluate_versions
    from deploy.evaluate import evaluate_on_stored_states, score_table, stored_score_table
    from deploy.evaluation import modes_of
    from deploy.run_folder import RunFolder

    if episodes is not None:
        _require_positive("episodes", episodes)
    _require_positive("jobs", jobs)
    if initial_states and stored_states is None:
        raise PresetError(
            f"--initial-states: expected none without --stored-states; got "
            f"{', '.join(initial_states)}; name a file of states"
        )
    run_folder = RunFolder(folder)
    chosen = mode or modes_of(run_folder.read_preset().algorithm)[0]
    if stored_states is None:
        table = score_table(evaluate_versions(run_folder, versions, episodes or 100, chosen, jobs))
    else:
        by_state = evaluate_on_stored_states(
            run_folder, versions, stored_states, initial_states, chosen, jobs, episodes
        )
        table = stored_score_table(by_state)
    Console().print(table)


@app.command(name="evaluator")
def evaluator(
    output: Path,
    connect: str = DEFAULT_ADDRESS,
    run: str | None = None,
    episodes: int = 20,
    id: str = "evaluator",  # noqa: A002 - the option's name
    priority: Priority = "idle",
    zenoh: tuple[str, ...] = (),
) -> None:
    """Score the policies of a run while it goes on.

    Args:
        output: Where results, policies and TensorBoard logs go: the run's own folder on the
            learner's machine, or any other, which is made like it.
        connect: Address of the router, or a run folder that `clothbus run` made.
        run: The run's name; not needed when the router carries one run.
        episodes: For each policy version and mode.
        id: This evaluator's name.
        priority: `idle` has what processor time is left over; `normal`, a share.
        zenoh: Zenoh settings, each key/path=value.
    """
    from deploy.roles import run_evaluator
    from deploy.run_folder import RunFolder

    _require_positive("episodes", episodes)
    run_evaluator(_address(connect), id, RunFolder(output), episodes, run, priority, zenoh)


@app.command(name="collect")
def collect(
    preset: Annotated[str, tyro.conf.Positional],
    /,
    output: Path,
    episodes: int = 10,
    demonstrator: Literal["scripted", "random"] = "scripted",
    random_rate: float = 0.0,
    quality: float | None = None,
    quality_episodes: int = 20,
    jobs: int = 1,
    settings: Settings = (),
) -> None:
    """Record demonstrations of a preset's task, without a learner.

    Args:
        preset: A preset's name or TOML file.
        output: Folder to record into; an unfinished one is continued.
        episodes: How many there shall be.
        demonstrator: Who acts.
        random_rate: Share of the script's actions that are replaced by random ones.
        quality: In place of a rate: 0 is as good as chance, 1 as the script. The rate is found.
        quality_episodes: By which the quality of each rate is measured.
        jobs: Processes that measure it.
        settings: Settings that replace the preset's.
    """
    from deploy.collect import collect_demonstrations
    from deploy.presets import load_preset
    from deploy.quality import kept_quality

    _require_positive("episodes", episodes)
    console = Console()
    chosen = load_preset(preset, settings)
    _refuse_unknown_task(chosen)
    if quality is not None:
        if random_rate or demonstrator != "scripted":
            raise PresetError(
                "collect: expected --quality with the scripted demonstrator and without "
                "--random-rate; got both; give one of them"
            )
        found = kept_quality(output, chosen.task, quality, quality_episodes, jobs)
        console.print(f"{found}", highlight=False, soft_wrap=True)
        random_rate = found.mistake_rate
    for trajectory in collect_demonstrations(chosen, output, episodes, demonstrator, random_rate):
        console.print(
            f"episode {trajectory.ticket.index + 1} of {episodes}: {trajectory.steps} steps, "
            f"return {trajectory.return_:.2f}, {'success' if trajectory.success else 'no success'}",
            highlight=False,
        )


app.command(name="task")(task_commands.task)
app.command(name="reach")(task_commands.reach)
app.command(name="watch")(task_commands.watch)
app.command(name="spread")(task_commands.spread)
app.command(name="states")(task_commands.states)
app.command(name="reproduce")(reproduce)
app.command(name="attention")(policy_commands.attention)


def _require_evaluable(episodes: int, in_process: bool) -> None:
    if episodes < 0 or (episodes and in_process):
        raise PresetError(
            f"--evaluate: expected 0 or more, and 0 with --in-process; got {episodes}; "
            "use `clothbus evaluate` after a run in one process"
        )


def _require_positive(option: str, value: int) -> None:
    if value < 1:
        raise PresetError(f"--{option}: expected at least 1; got {value}")


def _require_patience(hung_secs: float) -> None:
    if not hung_secs >= SHORTEST_HUNG_SECS:
        raise PresetError(
            f"--hung-secs: expected at least {SHORTEST_HUNG_SECS:g}; got {hung_secs:g}; in a "
            "shorter time a busy machine stands still by itself"
        )


def _address(connect: str) -> str:
    """The router's address, which a run folder holds in a file."""
    file = Path(connect) / "router.address"
    return file.read_text().strip() if file.is_file() else connect


def _only_run(address: str, zenoh: tuple[str, ...]) -> str:
    from deploy.status import only_run

    return only_run(address, zenoh)


def main() -> None:
    """Runs the command; errors that clothbus raises on purpose are one line, not a traceback."""
    end_with_supervisor()
    log_to_stderr()
    try:
        app.cli(prog="clothbus", description="Teach robots to handle cloth, over a message bus.")
    except ClothbusError as error:
        print(f"clothbus: {error}", file=sys.stderr)  # noqa: T201 - for the person who typed it
        is_unreachable = isinstance(error, RouterUnreachable)
        sys.exit(UNREACHABLE_EXIT if is_unreachable else CONFIGURATION_EXIT)
    except KeyboardInterrupt:
        sys.exit(unfinished_exit())


if __name__ == "__main__":
    main()
