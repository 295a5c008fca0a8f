"""The lock on a run."""

import os
import signal
import subprocess
import sys

import pytest

from broker_config.errors import AlreadyOwned, StorageError
from broker_config.ownership import own_run

HOLDER = """
import signal, sys
from pathlib import Path
from broker_config.ownership import own_run
with own_run(Path(sys.argv[1])):
    print("held", flush=True)
    signal.pause()
"""


def test_a_second_owner_is_refused_and_the_first_is_named(tmp_path):
    with own_run(tmp_path / "run"):
        with pytest.raises(AlreadyOwned, match=f"got pid {os.getpid()} on "):
            own_run(tmp_path / "run")
        own_run(tmp_path / "other").close()
    own_run(tmp_path / "run").close()


def test_the_lock_of_another_process_ends_with_kill_9(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, tmp_path], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "held\n"
    with pytest.raises(AlreadyOwned, match=f"got pid {process.pid} on "):
        own_run(tmp_path)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    lock = own_run(tmp_path)
    lock.close()
    lock.close()


def test_a_folder_that_cannot_be_made_is_a_storage_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match="expected a folder that can be written"):
        own_run(tmp_path / "file")
