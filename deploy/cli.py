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
from broker_config.session import DEFAULT_ADDRESS
from deploy.commands import (
    demonstrations,
    export,
    offline,
    policies,
    recordings,
    rewards,
    roles,
    tasks,
)
from deploy.commands.option_rules import (
    Settings,
    refuse_unknown_task,
    require_patience,
    require_positive,
)
from deploy.priority import Priority
from deploy.process import (
    CONFIGURATION_EXIT,
    UNREACHABLE_EXIT,
    end_with_supervisor,
    log_to_stderr,
    unfinished_exit,
)
from deploy.report.command import report
from deploy.reproduce.command import reproduce
from deploy.run_folder import router_address
from learner.steps.compute import Compute, TrainingPath

# What a command needs beyond this is imported when it runs: `clothbus status` shall not wait for
# torch and a physics engine.

app = tyro.extras.SubcommandApp()


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
        demonstrations: Folder of `clothbus demos make`, a run folder or a run's recording, for
            presets with an initialisation.
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
    from deploy.run_folder import RunFolder, create_run_folder, require_acting
    from deploy.running.kept_compute import settle_compute
    from deploy.running.run import RunOptions, run_over_bus

    require_positive("actors", actors)
    require_patience(hung_secs)
    _require_evaluable(evaluate, in_process)
    if (preset is None) == (resume is None):
        raise PresetError("run: expected a PRESET or --resume FOLDER; give exactly one of them")
    if resume is not None:
        folder = RunFolder(resume)
        require_acting(folder)
        chosen = folder.read_preset()
    else:
        chosen = load_preset(str(preset), settings)
        refuse_unknown_task(chosen)
        folder = create_run_folder(runs, chosen)
    options = RunOptions(
        actors=actors,
        compute=settle_compute(folder, Compute(device, training_path)),
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
        from deploy.running.run_in_process import run_in_process

        carry_out = run_in_process
    if not carry_out(folder, chosen, options, Console()):
        sys.exit(unfinished_exit())


@app.command(name="presets")
def presets() -> None:
    """List the presets that come with clothbus."""
    from deploy.presets import load_preset, preset_names

    table = Table("preset", "task", "source")
    for name in preset_names():
        preset = load_preset(name)
        table.add_row(name, preset.task.environment, preset.source)
    Console().print(table)


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
    from deploy.commands.status import read_status, status_table

    address = router_address(connect)
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
    from deploy.commands.status import send_control

    address = router_address(connect)
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
    from deploy.evaluation.evaluate import evaluate as evaluate_versions
    from deploy.evaluation.evaluate import (
        evaluate_on_stored_states,
        score_table,
        stored_score_table,
    )
    from deploy.evaluation.scores import modes_of
    from deploy.run_folder import RunFolder

    if episodes is not None:
        require_positive("episodes", episodes)
    require_positive("jobs", jobs)
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


app.command(name="router")(roles.router)
app.command(name="learner")(roles.learner)
app.command(name="actor")(roles.actor)
app.command(name="discriminator")(roles.discriminator)
app.command(name="record")(roles.record)
app.command(name="evaluator")(roles.evaluator)
app.command(demonstrations.app, name="demos", help="Make, import, show and label demonstrations.")
app.command(rewards.app, name="rewards", help="Check and draw discriminators' rewards.")
app.command(name="task")(tasks.task)
app.command(name="reach")(tasks.reach)
app.command(name="watch")(tasks.watch)
app.command(name="spread")(tasks.spread)
app.command(name="states")(tasks.states)
app.command(name="train")(offline.train)
app.command(name="replay")(offline.replay)
app.command(name="export")(export.export)
app.command(name="reproduce")(reproduce)
app.command(name="attention")(policies.attention)
app.command(name="info")(recordings.info)
app.command(name="check")(recordings.check)
app.command(name="recover")(recordings.recover)
app.command(name="slice")(recordings.slice_recording)
app.command(name="report")(report)


def _require_evaluable(episodes: int, in_process: bool) -> None:
    if episodes < 0 or (episodes and in_process):
        raise PresetError(
            f"--evaluate: expected 0 or more, and 0 with --in-process; got {episodes}; "
            "use `clothbus evaluate` after a run in one process"
        )


def _only_run(address: str, zenoh: tuple[str, ...]) -> str:
    from deploy.commands.status import only_run

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
