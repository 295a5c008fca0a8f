"""Sender and receiver over agentlace; run by an interpreter that has it, and knows no clothbus.

    PYTHON agentlace_ends.py receive|send PORT LOG COUNT RATE

The sender hands random bytes to a data store and updates the server after each; both ends note the
number of every message in a log. A second start goes on where the log ends.
"""

from __future__ import annotations

import logging
import os
import sys
import time
from pathlib import Path

from agentlace.data.data_store import QueuedDataStore
from agentlace.trainer import TrainerClient, TrainerConfig, TrainerServer
from number_log import Log  # beside this file

NAME = "actor"
PAYLOAD_BYTES = 21_000
CAPACITY = 1000
"""Messages that the sender keeps; what is older cannot be sent again."""
LAST_WORD_SECS = 30.0


class NotingStore(QueuedDataStore):
    """Notes what arrives."""

    def __init__(self, log: Log) -> None:
        super().__init__(CAPACITY)
        self._log = log

    def insert(self, data: tuple[int, bytes]) -> None:
        self._log.note(data[0])
        super().insert(data)


def config(port: int) -> TrainerConfig:
    return TrainerConfig(port_number=port, broadcast_port=port + 1)


def receive(port: int, log: Log) -> None:
    server = TrainerServer(config(port), log_level=logging.ERROR)
    server.register_data_store(NAME, NotingStore(log))
    server.start()


def send(port: int, log: Log, count: int, rate: float) -> None:
    store = QueuedDataStore(CAPACITY)
    client = TrainerClient(
        NAME, "127.0.0.1", config(port), store, log_level=logging.ERROR, wait_for_server=True
    )
    began_secs, first = time.monotonic(), log.lines
    for number in range(first, count):
        time.sleep(max(0.0, began_secs + (number - first) / rate - time.monotonic()))
        store.insert((number, os.urandom(PAYLOAD_BYTES)))
        log.note(number)
        client.update()
    deadline_secs = time.monotonic() + LAST_WORD_SECS
    while not client.update() and time.monotonic() < deadline_secs:
        time.sleep(0.5)
    client.stop()


if __name__ == "__main__":
    what, port, log, count, rate = sys.argv[1:]
    if what == "receive":
        receive(int(port), Log(Path(log)))
    else:
        send(int(port), Log(Path(log)), int(count), float(rate))
    os._exit(0)  # its sockets would wait for a server that is gone
