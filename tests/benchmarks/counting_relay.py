"""Counts the bytes of processes that attach to a router through it."""

from __future__ import annotations

import contextlib
import socket
import threading


class CountingRelay:
    """Stands between actors and router, and counts what the actors send."""

    def __init__(self, address: str) -> None:
        host, _, port = address.removeprefix("tcp/").rpartition(":")
        self._router = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self.sent_bytes = 0
        self._lock = threading.Lock()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            actor, _ = self._listener.accept()
            router = socket.create_connection(self._router)
            for source, target, counts in ((actor, router, True), (router, actor, False)):
                pump = threading.Thread(target=self._pump, args=[source, target, counts])
                pump.daemon = True
                pump.start()

    def _pump(self, source: socket.socket, target: socket.socket, counts: bool) -> None:
        with contextlib.suppress(OSError):  # one end has gone
            while data := source.recv(1 << 16):
                if counts:
                    with self._lock:
                        self.sent_bytes += len(data)
                target.sendall(data)
        target.close()
