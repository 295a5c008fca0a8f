"""What a run that is complete may still owe: spools to deliver, a recording to finish."""

from __future__ import annotations

import logging
import secrets

from broker_config.codec import decode
from broker_config.errors import StorageError
from broker_config.journal import Journal, JournalReader
from broker_config.messages import Trajectory
from broker_config.ownership import own_run
from broker_config.preset import Preset
from broker_config.recording.format import segment_paths
from broker_config.recording.reader import read_facts
from broker_config.spool import Spool
from deploy.process import take_when_free
from deploy.run_folder import RunFolder
from deploy.running.roles import SPOOL_MAX_BYTES
from learner.owner import Owner

_log = logging.getLogger(__name__)


def deliver_spools(folder: RunFolder, preset: Preset) -> int:
    """Journals what actors still held when a run ended; returns how many trajectories that were.

    None of them can be learned from any more, but they were acted, and the journal keeps all.

    Raises:
        AlreadyOwned: An actor or a learner of the run still lives.
        StorageError: Journal or spool cannot be used.
    """
    actors = sorted(path.stem for path in folder.spool("any").parent.glob("*.sqlite"))
    held = [actor for actor in actors if _holds_something(folder, actor)]
    if not held:
        return 0
    with take_when_free(lambda: own_run(folder.path)), Journal(folder.journal) as journal:
        owner = Owner(folder.run, preset, journal)
        delivered = sum(_deliver(folder, actor, owner) for actor in held)
    _log.info("Delivered %d trajectories that were left in spools", delivered)
    return delivered


def _holds_something(folder: RunFolder, actor: str) -> bool:
    with take_when_free(lambda: _open(folder, actor)) as spool:
        status = spool.status()
        return bool(status.trajectories or status.open_steps)


def _deliver(folder: RunFolder, actor: str, owner: Owner) -> int:
    delivered = 0
    with take_when_free(lambda: _open(folder, actor)) as spool:
        spool.recover()
        for item in spool.pending():
            owner.receive(decode(item.payload, Trajectory), item.payload).result()
            spool.acknowledge(item.id)
            delivered += 1
    return delivered


def _open(folder: RunFolder, actor: str) -> Spool:
    return Spool(folder.spool(actor), folder.run, actor, secrets.token_hex(8), SPOOL_MAX_BYTES)


def lacks_recording(folder: RunFolder) -> bool:
    """Whether a recording was begun and does not hold the whole journal yet.

    Raises:
        StorageError: The journal cannot be read.
    """
    segments = segment_paths(folder.recording) if folder.recording.is_dir() else []
    if not segments:
        return False
    with JournalReader(folder.journal) as journal:
        end_offset = journal.end_offset
    try:
        return read_facts(segments[-1]).next_offset < end_offset
    except StorageError:
        return True  # torn: the recorder mends it, or says what is wrong with it
