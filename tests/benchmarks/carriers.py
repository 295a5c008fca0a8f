"""Ray actor calls and gRPC unary calls that carry episodes and do nothing else with them."""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
from collections.abc import Callable
from concurrent import futures
from pathlib import Path
from typing import Any

from actors.delivery import WINDOW
from tests.benchmarks.episodes import ACTORS, episode_bytes
from tests.benchmarks.measuring import (
    Processes,
    Started,
    percentile,
    wait_for_file,
    wait_for_sign,
    wait_for_text,
)

END_SECS = 540.0


def measure_ray(episodes: int) -> dict[str, Any]:
    """Two Ray actors call a third with an episode's bytes, a window of calls each."""
    try:
        import ray
    except ModuleNotFoundError:
        return {"skipped": "ray is not installed: pip install clothbus[bench]"}
    ray.init(num_cpus=ACTORS + 1, include_dashboard=False, log_to_driver=False)
    try:
        return _measure_ray(ray, episodes)
    finally:
        ray.shutdown()


def _measure_ray(ray: Any, episodes: int) -> dict[str, Any]:
    class Sink:
        def take(self, payload: bytes) -> int:
            return len(payload)

    class Source:
        def send(self, sink: Any, payload: bytes, count: int) -> list[float]:
            # Values, as messages are: not one object in a store that several look at.
            began_secs: dict[Any, float] = {}
            latency: list[float] = []
            for number in range(count):
                if len(began_secs) == WINDOW:
                    (done,), _ = ray.wait(list(began_secs))
                    latency.append(time.monotonic() - began_secs.pop(done))
                fresh = number.to_bytes(8, "little") + payload[8:]
                now_secs = time.monotonic()
                began_secs[sink.take.remote(fresh)] = now_secs
            for reference, at_secs in began_secs.items():
                ray.get(reference)
                latency.append(time.monotonic() - at_secs)
            return latency

    sink = ray.remote(Sink).remote()
    sources = [ray.remote(Source).remote() for _ in range(ACTORS)]
    payload = episode_bytes()
    ray.get([source.send.remote(sink, payload, 10) for source in sources])  # all are up
    began_secs = time.monotonic()
    share = episodes // ACTORS
    lists = ray.get([source.send.remote(sink, payload, share) for source in sources])
    return _carried(episodes, time.monotonic() - began_secs, list(itertools.chain(*lists)))


def measure_grpc(episodes: int) -> dict[str, Any]:
    """Two processes make unary calls to a third, a window of calls each."""
    try:
        import grpc  # noqa: F401
    except ModuleNotFoundError:
        return {"skipped": "grpc is not installed: pip install clothbus[bench]"}
    with tempfile.TemporaryDirectory() as name, Processes(Path(name)) as processes:
        folder = Path(name)

        def start(part: str, who: str, address: str) -> Started:
            return processes.start(
                who, "-m", "tests.benchmarks.delivery_load", "--part", part, "--name", who,
                "--address", address, "--folder", folder, "--episodes", episodes,
                "--report", folder / f"{who}.json",
            )  # fmt: skip

        server = start("grpc-server", "server", "")
        address = wait_for_text(folder / "server.json", server)
        clients = [start("grpc-client", f"client-{n}", address) for n in range(ACTORS)]
        for number in range(ACTORS):
            wait_for_sign(folder / f"client-{number}.ready", [server, *clients])
        began_secs = time.monotonic()
        (folder / "start").touch()
        for client in clients:
            client.wait(END_SECS)
        reports = [json.loads((folder / f"client-{n}.json").read_text()) for n in range(ACTORS)]
    took_secs = max(it["last_secs"] for it in reports) - began_secs
    return _carried(episodes, took_secs, [t for it in reports for t in it["latency_secs"]])


_METHOD = "/clothbus.Bench/Take"
_UNLIMITED = [("grpc.max_receive_message_length", -1), ("grpc.max_send_message_length", -1)]


def run_grpc_server(arguments: argparse.Namespace) -> None:
    import grpc

    def take(payload: bytes, _: object) -> bytes:
        return len(payload).to_bytes(8, "little")

    class Handlers(grpc.GenericRpcHandler):  # type: ignore[misc]  # grpc has no types
        def service(self, details: Any) -> Any:
            is_ours = details.method == _METHOD
            return grpc.unary_unary_rpc_method_handler(take) if is_ours else None

    server = grpc.server(futures.ThreadPoolExecutor(ACTORS * WINDOW), options=_UNLIMITED)
    server.add_generic_rpc_handlers((Handlers(),))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    arguments.report.write_text(f"127.0.0.1:{port}")
    server.wait_for_termination()


def run_grpc_client(arguments: argparse.Namespace) -> None:
    import grpc

    payload, latency = episode_bytes(), list[float]()
    with grpc.insecure_channel(arguments.address, options=_UNLIMITED) as channel:
        take: Callable[..., Any] = channel.unary_unary(_METHOD)
        take(payload)  # it is connected
        (arguments.folder / f"{arguments.name}.ready").touch()
        wait_for_file(arguments.folder / "start")
        pending: list[tuple[float, Any]] = []
        for number in range(arguments.episodes // ACTORS):
            if len(pending) == WINDOW:
                began_secs, call = pending.pop(0)
                call.result()
                latency.append(time.monotonic() - began_secs)
            fresh = number.to_bytes(8, "little") + payload[8:]
            pending.append((time.monotonic(), take.future(fresh)))
        for began_secs, call in pending:
            call.result()
            latency.append(time.monotonic() - began_secs)
    report = {"latency_secs": latency, "last_secs": time.monotonic()}
    arguments.report.write_text(json.dumps(report))


def _carried(episodes: int, took_secs: float, latency: list[float]) -> dict[str, Any]:
    return {
        "episodes": episodes,
        "per_sec": round(episodes / took_secs, 1),
        "ms_to_reply_p50": round(1e3 * percentile(latency, 0.5), 1),
        "ms_to_reply_p99": round(1e3 * percentile(latency, 0.99), 1),
    }
