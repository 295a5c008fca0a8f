"""`clothbus report`: one page that says what became of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import tyro
from rich.console import Console

PAGE_FILE: Final = "report.html"


def report(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    output: Path | None = None,
) -> None:
    """Write a run as one HTML page: curves, rewards, episodes, time, processes, faults.

    Args:
        run: A run folder, finished or not; or the folder of a recording alone.
        output: The page to write; report.html in the folder if not given.
    """
    from rich.progress import Progress

    from deploy.process import use_one_torch_thread
    from deploy.report.gather import gather
    from deploy.report.page import render
    from deploy.report.sources import open_source

    use_one_torch_thread()
    source = open_source(run)
    path = run / PAGE_FILE if output is None else output
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("reading the journal", total=source.n_entries)
        record = gather(source, lambda entries: progress.update(task, completed=entries))
        progress.update(task, description="drawing", total=None)
        page = render(record, source.newest_policy(), source.missing)
    write_page(path, page)
    size = f"{path.stat().st_size / 1e6:.1f} MB"
    words = f"{path}: {size}, {len(record.episodes)} episodes, {record.entries} journal entries"
    Console().print(words, highlight=False, soft_wrap=True)


def write_page(path: Path, page: str) -> None:
    """Writes a page, whole or not at all.

    Raises:
        StorageError: The disk refuses.
    """
    from broker_config.durable import write_durably
    from broker_config.errors import StorageError

    try:
        write_durably(path, page.encode())
    except OSError as error:
        raise StorageError(
            f"report {path}: expected a file that can be written; got {error}; name another "
            "with --output"
        ) from error
